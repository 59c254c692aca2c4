"""At the desk: simulate, identify, synthesize, verify, deploy, tune, commission, diagnose (extra `lab`)."""
