"""Who acts in the cell, all by one protocol (`graspq.sim.play.Policy`): random, scripted, trained, a user's own."""
