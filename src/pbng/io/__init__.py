"""Meshes in; frames and the formats of other programs out."""
