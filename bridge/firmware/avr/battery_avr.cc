// See battery_avr.h.
#include "battery_avr.h"

#include <avr/io.h>

#include "../core/parameters.h"

namespace carril {

namespace {

constexpr uint8_t SAMPLES = 16;

uint16_t sum;
uint8_t samples;
uint16_t mean_16;
bool known;

}  // namespace

void battery_begin(uint8_t pin) {
    if (pin < FIRST_ANALOG_PIN || pin > LAST_ANALOG_PIN) return;
    const uint8_t channel = pin - FIRST_ANALOG_PIN;
    ADMUX = _BV(REFS0) | channel;
    if (channel < 6) DIDR0 = static_cast<uint8_t>(1 << channel);
    // 16 MHz / 128: 104 µs each, 1.7 ms for a mean.
    ADCSRA = _BV(ADEN) | _BV(ADPS2) | _BV(ADPS1) | _BV(ADPS0) | _BV(ADSC);
}

void battery_pass() {
    if ((ADCSRA & (_BV(ADEN) | _BV(ADSC))) != _BV(ADEN)) return;
    sum += ADC;
    if (++samples == SAMPLES) {
        mean_16 = sum;
        known = true;
        sum = 0;
        samples = 0;
    }
    ADCSRA |= _BV(ADSC);
}

bool battery_known() { return known; }

uint16_t battery_counts_16() { return mean_16; }

}  // namespace carril
