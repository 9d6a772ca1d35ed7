"""`python -m policy_export` is `export-policy`."""

from policy_export.cli import main

main()
