"""The deformation fields: their configuration, one module a field, their encoder and decoder as torch sees them."""
