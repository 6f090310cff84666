"""Rigid objects to grasp: seeded procedural shapes, the targeted task's set, and third-party meshes, as object sets."""
