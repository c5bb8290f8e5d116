"""The trainer: configuration, losses, optimiser, density control, evaluation."""
