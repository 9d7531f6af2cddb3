"""Where simulations run: in this process, in supervised workers, on a cluster."""
