"""The launcher: launch files, preflight, the supervisor of a node's processes and its control plane."""
