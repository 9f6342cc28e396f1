// Counts and stamps every edge of the encoder in an interrupt. Never filters: noise on the cable counts as edges.
#pragma once

#include "../core/calibration.h"
#include "../core/encoder.h"

namespace carril {

void encoder_begin(const Calibration& calibration);
// To be called at least every 8 s.
EncoderReading encoder_read(uint32_t now_us);

}  // namespace carril
