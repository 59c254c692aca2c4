"""The steps of a commissioning, one file each, in the order of the walk."""

from servod.lab.commission.steps.deploy import Deploy
from servod.lab.commission.steps.identify import Identify
from servod.lab.commission.steps.report import Report
from servod.lab.commission.steps.rivals import Rivals
from servod.lab.commission.steps.synthesize import Synthesize
from servod.lab.commission.steps.validate import Validate
from servod.lab.commission.steps.verify import Verify
from servod.lab.commission.walk import Step

STEPS: tuple[Step, ...] = (Identify(), Synthesize(), Verify(), Deploy(), Rivals(), Validate(), Report())
"""All steps in order."""
