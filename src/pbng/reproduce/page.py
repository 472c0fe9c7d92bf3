"""One HTML page for all that was reproduced, with its pictures inside, so that it can be sent around as one file."""

import base64
import html
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pbng import __version__
from pbng.io.store import put
from pbng.reproduce.section import Picture, Section

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #262c38; }
body { max-width: 62rem; margin: 2.5rem auto; padding: 0 1.25rem; }
h1 { font-size: 1.6rem; margin-bottom: .25rem; } h2 { font-size: 1.2rem; margin-top: 3rem; }
nav a { margin-right: .9rem; } a { color: #1f5a94; } .quiet { color: #5b6770; }
figure { margin: 1.2rem 0; } img { max-width: 100%; } figcaption { color: #5b6770; font-size: .9rem; }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: .92rem; }
th, td { text-align: left; vertical-align: top; padding: .35rem .9rem .35rem 0; border-bottom: 1px solid #dfe2e7; }
th { color: #5b6770; font-weight: 600; } td:nth-child(2), td:nth-child(3) { white-space: nowrap; }
"""


def write(sections: Sequence[Section], path: Path, machine: dict[str, Any]) -> Path:
    """Write the page, whole or not at all; returns its path.

    Raises:
        InputError: It cannot be written.
    """
    links = "".join(f'<a href="#{s.name}">{html.escape(s.name)}</a>' for s in sections)
    where = ", ".join(f"{key} {value}" for key, value in machine.items())
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>",
        f"<title>pbng: the paper reproduced</title><style>{STYLE}</style>",
        "<h1>Position-based nonlinear Gauss-Seidel, reproduced</h1>",
        f"<p class=quiet>pbng {html.escape(__version__)}; {html.escape(where)}. The paper's figures are those of Chen"
        " et al. (2024) on a Threadripper PRO 3995WX with 8 threads.</p>",
        f"<nav>{links}</nav>",
        *(_section(s) for s in sections),
        "</html>\n",
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    put(path, "\n".join(parts).encode())
    return path


def _section(s: Section) -> str:
    rows = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in (r.what, r.paper, r.ours, r.remark)) + "</tr>"
        for r in s.rows
    )
    table = f"<div class=wide><table><tr><th><th>paper<th>ours<th>remark</tr>{rows}</table></div>" if rows else ""
    return (
        f"<h2 id={s.name}>{html.escape(s.name)}: {html.escape(s.title)}</h2>"
        f"<p>{html.escape(s.scene)}</p><p><b>The paper:</b> {html.escape(s.claim)}</p>"
        f"<p><b>Here:</b> {html.escape(s.found)}</p>{table}{''.join(map(_figure, s.pictures))}"
    )


def _figure(p: Picture) -> str:
    data = base64.b64encode(p.path.read_bytes()).decode()
    return (
        f'<figure><img alt="{html.escape(p.caption, quote=True)}" src="data:image/png;base64,{data}">'
        f"<figcaption>{html.escape(p.caption)}</figcaption></figure>"
    )
