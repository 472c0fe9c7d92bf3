"""Constraint projection, one constraint after the other: what XPBD and PBD iterate (section 6)."""
