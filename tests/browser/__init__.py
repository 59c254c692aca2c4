"""Every report of servoctl, looked at in a real browser: `scripts/browser`."""
