"""Discovery: what moves is found before the training, so that it cannot be lost (docs/method.md).

A static fit at low resolution (`static_fit`) shows what stands still. Where training images differ from it
(`residual`), rays get depths on which images of neighbouring times agree (`surface_points`). Points of all times are
linked to tracks (`tracks`). Parts that turn become rigid bodies (`turns`, `rigid_fit`). The tracks become Gaussians,
and a deformation field that already moves them (`field_fit`).
`discover` runs these steps.
"""
