// Fuzzes the whole core: a conversation made of the fuzzer's bytes, good frames and bad ones, with time and readings as they
// come. Besides crashes it looks for what must never be: a motor that runs without a lease, a pulse beyond the servo's range, a
// direction that turns under PWM, a frame that the host cannot read.
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "../core/chip.h"

namespace {

using namespace carril;

uint8_t eeprom[1024];

uint8_t read_eeprom(uint16_t address) { return eeprom[address % sizeof eeprom]; }

struct Input {
    const uint8_t* data;
    size_t left;

    uint8_t u8() {
        if (left == 0) return 0;
        --left;
        return *data++;
    }
    uint16_t u16() {
        const uint8_t low = u8();
        return static_cast<uint16_t>(low | u8() << 8);
    }
    uint32_t u32() {
        const uint16_t low = u16();
        return low | static_cast<uint32_t>(u16()) << 16;
    }
};

bool hear(void* context, const uint8_t* bytes, uint8_t size) {
    Decoder<ChipPacket> decoder;
    ChipPacket packet = {};
    unsigned heard = 0;
    for (uint8_t i = 0; i < size; ++i) {
        if (decoder.push(bytes[i], packet) == Heard::packet) ++heard;
    }
    if (heard != 1 || decoder.damage().total() != 0) abort();
    return *static_cast<const bool*>(context);
}

// A frame that is intact, with fields as the fuzzer likes; mostly in session 1, so that conversations get somewhere.
void say(Chip& chip, Input& input, uint32_t now_us) {
    static const Kind kinds[] = {Kind::hello,           Kind::command,           Kind::command,
                                 Kind::fault_clear,     Kind::release,           Kind::estop,
                                 Kind::parameter_read,  Kind::parameter_write,   Kind::calibration_store,
                                 Kind::calibration_defaults, Kind::calibration_query, Kind::time_sync};
    HostPacket packet = {};
    packet.kind = kinds[input.u8() % (sizeof kinds / sizeof kinds[0])];
    packet.session = static_cast<uint16_t>(input.u8() % 8 == 0 ? 2 : 1);
    packet.steering_tenth_mrad = static_cast<int16_t>(input.u16());
    packet.raw = input.u8() % 2 != 0;
    packet.speed = static_cast<int16_t>(input.u16());
    if (packet.raw) packet.speed = static_cast<int16_t>(packet.speed % (FULL_DUTY + 1));
    packet.lease_ms = static_cast<uint16_t>(1 + input.u16() % MAX_LEASE_MS);
    packet.index = static_cast<uint8_t>(input.u8() % 28);
    packet.value = static_cast<int32_t>(input.u32());
    // Values within the range are rare among all; try to hit it.
    if (packet.index < PARAMETERS && input.u8() % 2 != 0) packet.value = parameter_default(packet.index) + packet.value % 500;
    packet.crc = input.u8() % 4 != 0 ? chip.calibration().crc() : input.u16();
    Wire wire(packet.kind, 0);
    write(wire, packet);
    wire.finish();
    for (uint8_t at = 0; at < wire.size();) {
        at = static_cast<uint8_t>(at + chip.receive(now_us, wire.bytes() + at, static_cast<uint8_t>(wire.size() - at)));
    }
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    Input input = {data, size};
    const bool blank = input.u8() % 2 == 0;
    memset(eeprom, 0xFF, sizeof eeprom);
    if (!blank) {
        for (uint8_t i = 0; i < 110; ++i) eeprom[i] = input.u8();
    }
    bool line_has_room = true;
    Chip chip(Line{hear, &line_has_room});
    chip.begin(read_eeprom, input.u8() % 8 == 0);
    uint32_t now_us = 0;
    Readings readings = {};
    readings.estop_level = true;
    readings.battery_known = true;
    readings.battery_counts_16 = 8730;
    uint8_t pwm = 0;
    bool direction = chip.pins().motor_direction_level;
    uint32_t without_lease_us = 0;
    while (input.left > 0) {
        switch (input.u8() % 6) {
            case 0:
            case 1: say(chip, input, now_us); break;
            case 2: {
                uint8_t bytes[32];
                const uint8_t n = static_cast<uint8_t>(input.u8() % sizeof bytes);
                for (uint8_t i = 0; i < n; ++i) bytes[i] = input.u8();
                for (uint8_t at = 0; at < n;) {
                    at = static_cast<uint8_t>(at + chip.receive(now_us, bytes + at, static_cast<uint8_t>(n - at)));
                }
                break;
            }
            case 3: {
                const uint16_t ticks = input.u8();
                readings.encoder.ticks += ticks;
                if (ticks != 0) readings.encoder.last_tick_us = now_us - input.u8();
                readings.encoder.period_us = input.u16();
                readings.encoder.backwards = input.u8() % 2 != 0;
                break;
            }
            case 4:
                readings.estop_level = input.u8() % 8 != 0;
                readings.battery_counts_16 = static_cast<uint16_t>(input.u16() % 16369);
                line_has_room = input.u8() % 8 != 0;
                break;
            default: break;
        }
        const uint32_t step_us = static_cast<uint32_t>(input.u8()) * (input.u8() % 32 == 0 ? 100000 : 50);
        now_us += step_us;
        const uint32_t ramp_us = static_cast<uint32_t>(chip.calibration()[Parameter::lease_ramp_ms]) * 1000;
        while (chip.step(now_us, readings)) {
        }
        uint8_t wanted;
        if (chip.calibration().storing()) {
            uint8_t& present = eeprom[chip.calibration().address()];
            if (chip.eeprom(present, wanted) && input.u8() % 16 != 0) present = wanted;
        }
        const Pins& pins = chip.pins();
        without_lease_us = chip.driving() ? 0 : without_lease_us + step_us;
        if (pins.motor_pwm != 0 && without_lease_us > ramp_us + 2 * step_us + 10000) abort();
        if (pins.motor_pwm != 0 && pwm != 0 && pins.motor_direction_level != direction) abort();
        if (pins.servo_us != 0 && (pins.servo_us < 500 || pins.servo_us > 2500)) abort();
        pwm = pins.motor_pwm;
        direction = pins.motor_direction_level;
    }
    return 0;
}
