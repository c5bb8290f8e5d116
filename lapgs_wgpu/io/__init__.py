"""Files that outlive a run: PLY checkpoints."""
