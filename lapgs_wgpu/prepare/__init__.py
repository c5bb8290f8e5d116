"""From films to a capture: frames, masks of what moves, camera poses, a diagnosis (docs/own-data.md)."""
