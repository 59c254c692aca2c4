"""The paper from this software: its figures, its numbers beside ours, and what agrees and what does not.

printed.py      what the paper prints
claims.py       a statement of the paper, judged by figures of the run
joints.py       the virtual axes that everything runs on, and the paper's gain sets in all readings
experiments.py  identification, design and tracking on a virtual axis, SYNC-stepped; every law tuned by the same rules
sweeps.py       what only the compiled simulator is fast enough for
equations.py    printed against consistent equations: friction
programme.py    printed against consistent equations: (12) to (15)
results.py      everything that a run found
friction.py, loops.py, motions.py, open_questions.py  the figures and their claims
table.py        the paper's numbers beside ours
document.py     files: JSON, Markdown, page, pictures
walk.py         all of it in order, on several processes, with progress and a clean end at Ctrl-C
"""
