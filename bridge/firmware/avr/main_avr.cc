// The firmware's start and its main loop: carries bytes and readings to the core and pins back. Decides nothing, never waits.
#include <avr/interrupt.h>
#include <avr/io.h>

#include "../core/chip.h"
#include "battery_avr.h"
#include "clock_avr.h"
#include "eeprom_avr.h"
#include "encoder_avr.h"
#include "motor_avr.h"
#include "pin_avr.h"
#include "servo_avr.h"
#include "uart_avr.h"
#include "watchdog_avr.h"

namespace carril {

namespace {

// So many bytes come in 640 µs; a pass takes less. They are few enough to keep the pass short.
constexpr uint8_t BYTES_PER_PASS = 32;

bool send_frame(void*, const uint8_t* bytes, uint8_t size) { return uart_send(bytes, size); }

Chip chip(Line{send_frame, nullptr});
Pin estop;

void begin() {
    chip.begin(eeprom_read, watchdog_has_bitten());
    const Calibration& calibration = chip.calibration();
    motor_begin(calibration, chip.pins());
    clock_begin();
    servo_begin(Pin(static_cast<uint8_t>(calibration[Parameter::servo_pin])));
    encoder_begin(calibration);
    battery_begin(static_cast<uint8_t>(calibration[Parameter::battery_pin]));
    estop = Pin(static_cast<uint8_t>(calibration[Parameter::estop_pin]));
    estop.make_input_with_pull_up();
    uart_begin();
    watchdog_begin();
    sei();
}

Readings readings(uint32_t now_us) {
    return {encoder_read(now_us), battery_counts_16(), battery_known(), estop.level()};
}

void store_calibration() {
    if (!chip.calibration().storing() || !eeprom_ready()) return;
    const uint16_t address = chip.calibration().address();
    uint8_t byte;
    if (chip.eeprom(eeprom_read(address), byte)) eeprom_write(address, byte);
}

}  // namespace

// One pass of the main loop. Not inlined, so that a simulator finds it by its name and measures how long a pass takes.
extern "C" __attribute__((noinline, used)) void main_loop_pass() {
    const uint8_t* bytes;
    const uint8_t size = uart_received(bytes, BYTES_PER_PASS);
    const uint32_t now_us = clock_us();
    uart_drop(chip.receive(now_us, bytes, size));
    chip.step(now_us, readings(now_us));
    motor_set(chip.pins());
    servo_set(chip.pins().servo_us);
    battery_pass();
    store_calibration();
    // With interrupts off the clock would stand still, and no lease would ever run out.
    if ((SREG & _BV(SREG_I)) != 0) watchdog_kick();
}

}  // namespace carril

int main() {
    carril::begin();
    for (;;) carril::main_loop_pass();
}
