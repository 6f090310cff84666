"""Scoring of policies: rollouts on held-out objects, statistics and batch jobs.

Statistics and jobs import neither PyBullet nor PyTorch; only rollouts need the simulator.
"""
