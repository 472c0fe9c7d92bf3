"""Methods side by side: one problem, one start, one residual, one clock (``pbng compare``, docs/comparing.md)."""
