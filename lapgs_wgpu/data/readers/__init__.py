"""Readers of capture formats, one per file. Each returns frames and an optional cloud (`frames.Capture`)."""
