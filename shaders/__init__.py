"""WGSL and nothing else: one file a pass. This file only makes the folder a package, so that it is installed."""
