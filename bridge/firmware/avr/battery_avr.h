// The battery's voltage on an analogue pin, against the supply of the chip. Converts in the background; never waits for it.
#pragma once

#include <stdint.h>

namespace carril {

// `pin`: Arduino's number, A0 (14) to A7 (21), or NO_PIN.
void battery_begin(uint8_t pin);
// To be called in each pass.
void battery_pass();
bool battery_known();
// Mean of 16 conversions, 1/16 count.
uint16_t battery_counts_16();

}  // namespace carril
