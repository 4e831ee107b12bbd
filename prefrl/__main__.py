"""`python -m prefrl` is the command line."""

from prefrl.cli.main import main

if __name__ == "__main__":
    main()
