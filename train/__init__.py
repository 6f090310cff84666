"""Training of Q-functions from shards: targets, action selection, the estimators' table, networks and the loop.

It never imports the simulator.
"""
