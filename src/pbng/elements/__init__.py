"""Element kinds: the stencils that the sweep knows, one file each."""
