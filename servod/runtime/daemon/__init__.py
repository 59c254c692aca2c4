"""The supervisor process `servod`: everything around the loop and nothing in it.

Configures the nodes through the master, starts and watches the loop process, serves the control socket, records,
counts and tells systemd. Imports neither numpy nor anything else of the laboratory.
"""
