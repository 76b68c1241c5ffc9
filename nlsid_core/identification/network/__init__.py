"""Networks of maps of bounded slope: how each structure is fitted."""
