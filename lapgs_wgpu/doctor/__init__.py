"""lapgs-doctor: a report of the system, its adapters and a self-test of the kernels, to paste into an issue."""
