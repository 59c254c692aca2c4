"""What a model leaves out of an axis: recordings in, named physics out.

Off the control path; needs the lab extra. Six floors, each importing those below it only:

engine, document, explain   the stages in their order; the result as JSON and sentences; an effect explained
judge/                      what a selection is worth: errors, intervals, findings, verdict, and the finished result
select/                     fits, and the selection of terms in stages, cross-validation the last
effects/                    the physics that can be named
predict/                    model against recording, sample by sample: the mismatch as a torque
data/, result, settings     recordings checked, as traces; what a diagnosis returns; every number it is tuned by
"""
