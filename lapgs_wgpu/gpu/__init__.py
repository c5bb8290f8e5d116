"""Choosing an adapter, composing WGSL, binding buffers by name, scan and sort. Knows nothing of splats."""
