"""WGSL that several passes import."""
