"""Presets of lapgs-train. This file only makes the folder a package, so that it is installed."""
