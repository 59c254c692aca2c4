"""The steps of a commissioning in the order of the walk, one file each; a set is made and judged in one."""

from servod.lab.commission.report import Report
from servod.lab.commission.steps.deploy import Deploy
from servod.lab.commission.steps.identify import Identify
from servod.lab.commission.steps.rivals import Rivals
from servod.lab.commission.steps.synthesize import Synthesize, Verify
from servod.lab.commission.steps.validate import Validate
from servod.lab.commission.walk import Step

STEPS: tuple[Step, ...] = (Identify(), Synthesize(), Verify(), Deploy(), Rivals(), Validate(), Report())
"""All steps in order."""
