"""The simulated grasping cell: arm, bin, camera, the two tasks, and the policies that need no learning.

PyBullet is imported inside this folder alone.
"""
