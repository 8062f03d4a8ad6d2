"""A rendered aerial clip with known boxes: the demo, and a data set that needs no files."""
