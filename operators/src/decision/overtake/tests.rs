//! Overtaking, step by step.
