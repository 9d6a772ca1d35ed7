"""`python -m flight.guard URL DESCRIPTOR PRIORITY`: started by `fly`, which holds the other end of the socket."""

import socket
import sys

from flight.guard.process import serve

serve(sys.argv[1], socket.socket(fileno=int(sys.argv[2])), int(sys.argv[3]))
