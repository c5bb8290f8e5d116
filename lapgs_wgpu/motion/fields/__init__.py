"""Deformation fields: configuration, one module per field, and their encoder and decoder as torch functions."""
