"""`warploom eval`: what the package finds, measured on data sets."""
