"""`python -m campaigns.adversaries`."""

from campaigns.adversaries.cli import main

if __name__ == "__main__":
    main()
