"""Captures: readers of their formats, one pipeline that makes a dataset of what they return, and the built-in scene."""

from lapgs_wgpu.data.load import load_dataset
from lapgs_wgpu.data.views import Dataset, View, composite

__all__ = ["Dataset", "View", "composite", "load_dataset"]
