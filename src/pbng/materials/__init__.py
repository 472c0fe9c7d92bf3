"""Hyperelastic materials: one file a model."""
