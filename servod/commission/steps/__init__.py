"""The steps of a commissioning, one file each, in the order of the walk."""

from servod.commission.steps.deploy import Deploy
from servod.commission.steps.identify import Identify
from servod.commission.steps.report import Report
from servod.commission.steps.rivals import Rivals
from servod.commission.steps.synthesize import Synthesize
from servod.commission.steps.validate import Validate
from servod.commission.steps.verify import Verify
from servod.commission.walk import Step

STEPS: tuple[Step, ...] = (Identify(), Synthesize(), Verify(), Deploy(), Rivals(), Validate(), Report())
"""All steps in order."""
