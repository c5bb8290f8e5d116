"""Devices, WGSL preprocessing, kernels with arrays bound by name, scan, sort, matrix products. Knows no splats."""
