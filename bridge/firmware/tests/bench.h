// A chip on the bench: its time, its sensors, its EEPROM, and a host that says what the test wants. Never runs by itself.
#pragma once

#include <stdint.h>
#include <stdlib.h>

#include <stdexcept>
#include <vector>

#include "../core/chip.h"

namespace carril {

constexpr uint16_t OUR_SESSION = 0x1234;

using Bytes = std::vector<uint8_t>;

template <class Fields>
Bytes wire_of(Kind kind, uint16_t seq, const Fields& fields, uint8_t version = PROTOCOL_VERSION) {
    Wire wire(kind, seq, version);
    write(wire, fields);
    wire.finish();
    return Bytes(wire.bytes(), wire.bytes() + wire.size());
}

inline Bytes wire_of(const HostPacket& packet, uint8_t version = PROTOCOL_VERSION) {
    return wire_of(packet.kind, packet.seq, packet, version);
}

inline HostPacket packet_of(Kind kind, uint16_t session = 0) {
    HostPacket packet = {};
    packet.kind = kind;
    packet.session = session;
    return packet;
}

inline HostPacket hello(uint16_t session) { return packet_of(Kind::hello, session); }
inline HostPacket fault_clear(uint16_t session) { return packet_of(Kind::fault_clear, session); }
inline HostPacket release(uint16_t session) { return packet_of(Kind::release, session); }
inline HostPacket estop() { return packet_of(Kind::estop); }

inline HostPacket command(uint16_t session, int16_t speed_mm_s, uint16_t lease_ms, int16_t steering_tenth_mrad = 1000) {
    HostPacket packet = packet_of(Kind::command, session);
    packet.speed = speed_mm_s;
    packet.lease_ms = lease_ms;
    packet.steering_tenth_mrad = steering_tenth_mrad;
    return packet;
}

inline HostPacket raw_command(uint16_t session, int16_t duty, uint16_t lease_ms) {
    HostPacket packet = command(session, duty, lease_ms);
    packet.raw = true;
    return packet;
}

inline HostPacket parameter_write(uint16_t session, Parameter parameter, int32_t value) {
    HostPacket packet = packet_of(Kind::parameter_write, session);
    packet.index = static_cast<uint8_t>(parameter);
    packet.value = value;
    return packet;
}

inline HostPacket parameter_read(uint8_t index) {
    HostPacket packet = packet_of(Kind::parameter_read);
    packet.index = index;
    return packet;
}

inline HostPacket calibration_store(uint16_t session, uint16_t crc) {
    HostPacket packet = packet_of(Kind::calibration_store, session);
    packet.crc = crc;
    return packet;
}

class Bench {
public:
    // A chip that has been on for `age_us`.
    explicit Bench(uint32_t age_us = 0) : chip(Line{hear, this}) {
        readings.battery_counts_16 = 8730;  // 8.0 V
        readings.battery_known = true;
        readings.estop_level = true;  // not pressed
        eeprom().assign(1024, 0xFF);
        chip.begin(read_eeprom, false);
        constexpr uint32_t MINUTE_US = 60000000;
        for (; age_us - now_us > MINUTE_US; now_us += MINUTE_US) step();
        now_us = age_us;
    }

    static Bench driving(uint32_t age_us = 0) {
        Bench bench(age_us);
        bench.drive();
        return bench;
    }

    // Not copied: the line points at it.
    Bench(const Bench&) = delete;
    Bench(Bench&& other) noexcept
        : chip(other.chip), now_us(other.now_us), readings(other.readings), heard(other.heard),
          encoder_works(other.encoder_works), seq_(other.seq_), decoder_(other.decoder_) {
        chip.connect(Line{hear, this});
    }

    void drive() {
        run_ms(1);
        say(hello(OUR_SESSION));
        say(command(OUR_SESSION, 500, 200));
        run_ms(10);
    }

    // What is in the EEPROM outlasts a bench, until the next one blanks it.
    static Bytes& eeprom() {
        static Bytes bytes(1024, 0xFF);
        return bytes;
    }

    void restart(bool by_watchdog = false) {
        chip = Chip(Line{hear, this});
        now_us = 0;
        chip.begin(read_eeprom, by_watchdog);
    }

    void bytes(const Bytes& all) {
        for (size_t at = 0; at < all.size();) {
            const size_t left = all.size() - at;
            at += chip.receive(now_us, all.data() + at, static_cast<uint8_t>(left < 32 ? left : 32));
        }
    }

    void say(HostPacket packet) {
        packet.seq = seq_++;
        bytes(wire_of(packet));
    }

    void step() {
        while (chip.step(now_us, readings)) {
        }
        if (chip.calibration().storing() && eeprom_ready) {
            uint8_t wanted;
            uint8_t& present = eeprom()[chip.calibration().address()];
            if (chip.eeprom(present, wanted)) {
                if (eeprom_works) present = wanted;
                ++eeprom_writes;
            }
        }
    }

    // In steps of 1 ms, with a wheel that turns while the motor does.
    void run_ms(uint32_t ms) {
        for (uint32_t i = 0; i < ms; ++i) {
            now_us += 1000;
            if (chip.pins().motor_pwm != 0 && encoder_works && now_us / 1000 % 3 == 0) tick(3000);
            step();
        }
    }

    void tick(uint32_t period_us) {
        ++readings.encoder.ticks;
        readings.encoder.last_tick_us = now_us;
        readings.encoder.period_us = period_us;
    }

    // Keeps the lease alive for so long.
    void drive_ms(uint32_t ms, int16_t speed_mm_s = 500, uint16_t session = OUR_SESSION) {
        for (uint32_t i = 0; i < ms / 50; ++i) {
            say(command(session, speed_mm_s, 200));
            run_ms(50);
        }
    }

    bool has_heard(Kind kind) const {
        for (const ChipPacket& packet : heard) {
            if (packet.kind == kind) return true;
        }
        return false;
    }

    // The last frame of this kind. That there is none fails the test.
    const ChipPacket& last(Kind kind) const {
        for (size_t i = heard.size(); i-- > 0;) {
            if (heard[i].kind == kind) return heard[i];
        }
        throw std::runtime_error("the chip has sent no such frame");
    }

    Telemetry telemetry() const { return last(Kind::telemetry).telemetry; }

    bool braking() const { return chip.pins().motor_pwm == 0 && !chip.driving(); }

    Chip chip;
    uint32_t now_us = 0;
    Readings readings = {};
    std::vector<ChipPacket> heard;
    bool encoder_works = true;
    bool eeprom_works = true;
    bool eeprom_ready = true;
    unsigned eeprom_writes = 0;
    // Frames find no room.
    bool line_full = false;
    unsigned refused = 0;

private:
    static uint8_t read_eeprom(uint16_t address) { return eeprom()[address]; }

    static bool hear(void* context, const uint8_t* bytes, uint8_t size) {
        Bench& bench = *static_cast<Bench*>(context);
        if (bench.line_full) {
            ++bench.refused;
            return false;
        }
        for (uint8_t i = 0; i < size; ++i) {
            ChipPacket packet;
            const Heard heard = bench.decoder_.push(bytes[i], packet);
            if (heard == Heard::packet) bench.heard.push_back(packet);
            if (heard != Heard::packet && heard != Heard::nothing) abort();
        }
        return true;
    }

    uint16_t seq_ = 0;
    Decoder<ChipPacket> decoder_;
};

}  // namespace carril
