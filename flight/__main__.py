"""`python -m flight` is `fly`."""

from flight.cli import main

if __name__ == "__main__":
    main()
