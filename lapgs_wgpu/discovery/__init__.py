"""Discovery: what moves is found before the training, so that it cannot be lost. `discover` runs the steps of
docs/method.md, a module each."""
