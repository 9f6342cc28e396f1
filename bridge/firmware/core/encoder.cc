// See encoder.h.
#include "encoder.h"

namespace carril {

namespace {

// Without a tick for so long, the wheel counts as standing.
constexpr uint32_t STANDING_AFTER_US = 200000;
// A pause up to this is no slowing down. The chip could do with less; it is the model's value, which must drive alike.
constexpr uint32_t SLACK_US = 20000;
// Slower than any wheel: keeps sixteenths of µs within 32 bits.
constexpr uint32_t LONGEST_PERIOD_US = 100000000;

uint32_t sixteenths(uint32_t period_us) {
    return 16 * (period_us < LONGEST_PERIOD_US ? period_us : LONGEST_PERIOD_US);
}

}  // namespace

bool Encoder::standing(uint32_t now_us) const {
    return !last_tick_.known() || last_tick_.age_us(now_us) >= STANDING_AFTER_US;
}

void Encoder::read(const EncoderReading& reading, uint32_t now_us) {
    last_tick_.keep(now_us);
    if (reading.ticks == ticks_) return;
    const bool first = !last_tick_.known();
    const bool one = reading.ticks - ticks_ == 1;
    // After a long pause the reading's period may have wrapped; the pause itself is known here.
    const uint32_t pause_us = first ? 0 : last_tick_.age_us(reading.last_tick_us);
    period_us_ = one && pause_us >= STANDING_AFTER_US ? pause_us : reading.period_us;
    has_period_ = !(one && first);
    ticks_ = reading.ticks;
    last_tick_us_ = reading.last_tick_us;
    last_tick_.set(reading.last_tick_us);
}

void Encoder::measure(uint32_t now_us, int32_t tick_nm) {
    const uint32_t ticks = ticks_ - measured_ticks_;
    if (ticks != 0) {
        // The mean over several ticks: edges of a real encoder are not evenly spaced.
        mean_period_16_ = stood_ ? sixteenths(period_us_) : sixteenths(last_tick_us_ - measured_tick_us_) / ticks;
        measured_ticks_ = ticks_;
        measured_tick_us_ = last_tick_us_;
    }
    stood_ = !has_period(now_us);
    if (stood_) {
        speed_mm_s_ = 0;
        return;
    }
    const uint32_t since_us = last_tick_.age_us(now_us);
    const uint32_t pause_16 = since_us > SLACK_US ? 16 * (since_us - SLACK_US) : 0;
    uint32_t period_16 = mean_period_16_ > pause_16 ? mean_period_16_ : pause_16;
    if (period_16 == 0) period_16 = 1;
    // nm per µs are mm per s. A tick has at most 1e8 nm.
    const uint32_t speed = (16 * static_cast<uint32_t>(tick_nm) + period_16 / 2) / period_16;
    speed_mm_s_ = static_cast<int16_t>(speed < INT16_MAX ? speed : INT16_MAX);
}

}  // namespace carril
