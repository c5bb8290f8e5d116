"""Splat files and checkpoints; JSON, TOML and safetensors files; configuration tables."""
