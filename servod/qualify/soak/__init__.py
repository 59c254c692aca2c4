"""The long run: random moves and faults from a seed for hours of axis time, with everything accounted for.

Beside the data path, above the fault campaign whose actions it takes. `kinds` is the table of faults with what each may
do, `plan` draws the schedule, `stepped` runs it in virtual time and `wall` on real processes; `rows`, `syncs` and
`drive` check what was recorded, `memory` watches the process; `tally`, `document` and `page` tell. Used by
`servoctl qualify soak` and tests. Needs the lab part (numpy).
"""
