"""`grasp-study`: a comparison of estimators from a plan in a file, its recipe frozen, its scores in one table."""
