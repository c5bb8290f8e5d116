"""How Gaussians move: the hash encoder, the deformation field, the 4D scene."""
