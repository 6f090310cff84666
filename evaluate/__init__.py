"""Scoring of policies: rollouts on held-out objects, statistics, batch jobs and the report.

Statistics, jobs and reports import neither PyBullet nor PyTorch; only rollouts need the simulator.
"""
