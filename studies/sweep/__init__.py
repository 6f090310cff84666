"""Sweeps: a training and its evaluation at every point of a grid."""
