"""The methods of `identify`, and the minimisers that they are made of."""
