"""The viewer: a trained scene, or any 3DGS .ply, in a window, in a browser or without a screen, at any time."""
