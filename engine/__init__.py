"""Units of work on processes of this machine or on a Ray cluster: the only place that starts processes."""
