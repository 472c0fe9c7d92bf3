"""Images into an .mp4 that plays everywhere: H.264, 4:2:0, by the ffmpeg that imageio-ffmpeg brings."""

import os
import subprocess
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Self

import numpy as np

from pbng.errors import InputError

# With no word on colour they would be converted by one standard and shown by another.
COLOR = "scale=out_color_matrix=bt709:out_range=tv,setparams=color_primaries=bt709:color_trc=bt709:colorspace=bt709"
OPTIONS = f"-an -vf {COLOR} -c:v libx264 -preset veryfast -crf 17 -pix_fmt yuv420p -movflags +faststart"


class Video:
    """``with Video(path, size, fps) as video: video.write(image)``; the file appears when all went well.

    Args:
        path: The .mp4.
        size: Width and height [pixels], both even.
        fps: Images a second.

    Raises:
        InputError: imageio-ffmpeg is not installed, or the file cannot be written; it says what ffmpeg said.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        self.path = path
        self.temporary = path.with_name(f".{path.stem}.tmp{path.suffix}")
        self.said = tempfile.TemporaryFile()  # noqa: SIM115, closed on exit
        source = f"-f rawvideo -pix_fmt rgb24 -s {size[0]}x{size[1]} -r {fps} -i -".split()
        self.process = subprocess.Popen(
            [_ffmpeg(), "-y", "-loglevel", "error", *source, *OPTIONS.split(), str(self.temporary.absolute())],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self.said,
        )

    def write(self, image: np.ndarray) -> None:
        """Add an image (height, width, 3) uint8."""
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(np.ascontiguousarray(image).tobytes())
        except OSError:
            raise self._failure() from None

    def _failure(self) -> InputError:
        self.process.wait()
        self.said.seek(0)
        return InputError(f"cannot write {self.path}: {self.said.read().decode(errors='replace').strip()}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        assert self.process.stdin is not None
        try:
            with suppress(OSError):
                self.process.stdin.close()
            if kind is not None:
                self.process.kill()
                self.process.wait()
            elif self.process.wait() != 0:
                raise self._failure()
            else:
                os.replace(self.temporary, self.path)
        finally:
            self.temporary.unlink(missing_ok=True)
            self.said.close()


def _ffmpeg() -> str:
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise InputError(f"films need imageio-ffmpeg: pip install 'pbng[view]' ({error})") from error
    return imageio_ffmpeg.get_ffmpeg_exe()
