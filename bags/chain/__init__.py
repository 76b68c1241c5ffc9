"""The chain in files, from recordings to a verdict; and simulated robots to try it on."""
