"""The figures of identification, design and motion, one file for each group; all return
`servod.lab.report.figure.Figure`.

friction.py   Dahl curve, friction-velocity map (Fig. 7, 8)
sets.py       weighting functions, friction of the local sets (Fig. 2)
loop.py       frequency responses before and after compensation, impulse responses at every vertex (Fig. 4, 6);
              response of the sliding joint, with its coherence; the certificate as a table
motion.py     tracking, steps, friction under disturbance, before and after (Fig. 9 to 12, 15 to 18)
"""
