"""Rasterising 3D Gaussians: the camera, the passes, their float64 reference."""
