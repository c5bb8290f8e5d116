"""Rasterization of 3D Gaussians: the camera, the Gaussians, the device passes and their autograd function."""
