"""`python -m gbid`: the command line, where the command `gbid` is not on the path."""

from gbid.cli.main import main

if __name__ == "__main__":
    main()
