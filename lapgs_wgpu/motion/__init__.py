"""Deformation fields, which move Gaussians; the 4D scene; its playback."""
