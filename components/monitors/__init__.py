"""What is watched beside the processes of a node: its GPUs, and how fragmented the memory is."""
