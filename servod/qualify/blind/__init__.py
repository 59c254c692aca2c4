"""A blind trial of the diagnosis that anyone can run: axes conceal physics, the diagnosis sees recordings alone.

Off the control path; needs the lab extra. `physics` and `plant` are an axis of their own (equations, integrator) that
shares no code with the simulator of the diagnosis; `axes` and `motions` draw joints and what they do, `hidden` what is
concealed, `plan` the mix of cases, `conceal` writes them and seals the truth, `examine` runs `servoctl diagnose` on
each folder alone, `score` opens the seal and counts, `document` and `figures` show it.
"""
