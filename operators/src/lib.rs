//! The operators of carril, one file each, and their registry. Pure: no Zenoh, no serial port, no wall clock.
