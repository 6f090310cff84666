"""Collection of random-policy grasps into a dataset: blocks as pure functions, a plan of shards."""
