"""The literal algorithms of the thesis, beside the faster ones."""
