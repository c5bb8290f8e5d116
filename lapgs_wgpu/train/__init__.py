"""The trainer: configuration, losses, optimizer, density control, evaluation."""
