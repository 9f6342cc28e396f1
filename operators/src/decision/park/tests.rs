//! Parking as a whole.
