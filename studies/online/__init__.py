"""The paper's on-policy setting: training that alternates with fresh grasps of the latest policy."""
