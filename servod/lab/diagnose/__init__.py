"""What a model leaves out of an axis: recordings in, named physics out.

Off the control path; needs the lab extra. `intake` checks the recordings, `predict` compares model and recording sample
by sample, `fit` estimates, `effects` holds the physics that can be named, `choose` decides what is named, `locate` says
where the mismatch lives, `engine` runs it all and `document` writes what was found.
"""
