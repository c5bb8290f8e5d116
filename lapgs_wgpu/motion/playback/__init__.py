"""Showing a scene at any time, where possible without torch."""
