"""graspq: an open benchmark for vision-based robotic grasping with off-policy Q-function estimators.

The folders beside this one are its subpackages (`objects/` is `graspq.objects`, and so on); importing graspq itself
registers the Gymnasium environments by name only, so PyBullet is not imported until one of them is made.
"""

from gymnasium.envs.registration import register

__version__ = "0.1.0"

register(id="graspq/Grasping-v0", entry_point="graspq.sim.environments:Grasping")
register(id="graspq/RegularGrasping-v0", entry_point="graspq.sim.environments:Grasping", kwargs={"task": "regular"})
register(id="graspq/TargetedGrasping-v0", entry_point="graspq.sim.environments:Grasping", kwargs={"task": "targeted"})
