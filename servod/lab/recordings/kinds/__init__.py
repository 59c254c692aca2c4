"""One module for each kind of file that recordings come in; `readers` chooses by the suffix."""
