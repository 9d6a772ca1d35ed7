"""``python -m sim_gateway`` is ``sim-gateway``."""

from sim_gateway.cli import main

main()
