//! Physics: engines behind one batch-first trait, servo, backlash, terrain, sensors.
