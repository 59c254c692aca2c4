"""The one way to command an axis: under a daemon, stepped in virtual time, or virtual."""
