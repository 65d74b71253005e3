"""`python -m envtf_lit` is `envtf`."""

from envtf_lit.cli.main import main

main()
