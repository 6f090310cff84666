"""Plans of many runs: they call the commands, skip what is done and collect rows."""
