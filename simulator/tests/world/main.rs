//! Tests of the operator `sim-world` as a whole, in one binary.

mod bad_tracks;
mod closed_loop;
mod floor_picture;
mod operator;
mod rig;
#[path = "../../../tests/support/thorough.rs"]
mod thorough;
