"""The simulated grasping cell: arm, bin, camera, tasks, the loop that plays an episode, Gymnasium environments.

PyBullet is imported inside this folder alone.
"""
