// See frame.h. Reading past the end gives zeros and writing past it nothing; both are bugs that the tests see, and neither
// touches memory that is not the frame's.
#include "frame.h"

#include "crc16.h"

namespace carril {

namespace {

constexpr uint8_t HEADER_BYTES = 4;
constexpr uint8_t CRC_BYTES = 2;
constexpr uint8_t NO_SUCH_KIND = 0xFF;

class Fields {
public:
    Fields(const uint8_t* bytes, uint8_t size) : bytes_(bytes), left_(size) {}

    uint8_t u8() {
        if (left_ == 0) return 0;
        --left_;
        return *bytes_++;
    }

    uint16_t u16() {
        const uint8_t low = u8();
        return static_cast<uint16_t>(low | (u8() << 8));
    }

    int16_t i16() { return static_cast<int16_t>(u16()); }

    uint32_t u32() {
        const uint16_t low = u16();
        return low | (static_cast<uint32_t>(u16()) << 16);
    }

private:
    const uint8_t* bytes_;
    uint8_t left_;
};

uint8_t host_field_bytes(uint8_t kind) {
    switch (static_cast<Kind>(kind)) {
        case Kind::estop:
        case Kind::calibration_query: return 0;
        case Kind::parameter_read: return 1;
        case Kind::hello:
        case Kind::fault_clear:
        case Kind::release:
        case Kind::time_sync:
        case Kind::calibration_defaults: return 2;
        case Kind::calibration_store: return 4;
        case Kind::parameter_write: return 7;
        case Kind::command: return 9;
        default: return NO_SUCH_KIND;
    }
}

uint8_t chip_field_bytes(uint8_t kind) {
    switch (static_cast<Kind>(kind)) {
        case Kind::parameter:
        case Kind::calibration: return 6;
        case Kind::hello_ack: return 9;
        case Kind::time_sync_ack: return 10;
        case Kind::telemetry: return 29;
        default: return NO_SUCH_KIND;
    }
}

// What all frames have in common, whoever sent them. `expected` is the size of the fields of this kind.
Heard check(const uint8_t* raw, uint8_t size, uint8_t expected) {
    if (size < HEADER_BYTES + CRC_BYTES) return Heard::stuffing;
    const uint8_t covered = static_cast<uint8_t>(size - CRC_BYTES);
    if (crc16(raw, covered) != Fields(raw + covered, CRC_BYTES).u16()) return Heard::checksum;
    if (raw[0] != PROTOCOL_VERSION) return Heard::version;
    if (expected == NO_SUCH_KIND) return Heard::kind;
    return covered - HEADER_BYTES == expected ? Heard::packet : Heard::fields;
}

bool read_command(Fields& fields, HostPacket& packet) {
    packet.steering_tenth_mrad = fields.i16();
    packet.speed = fields.i16();
    packet.lease_ms = fields.u16();
    const uint8_t flags = fields.u8();
    packet.raw = flags == 1;
    if (packet.lease_ms < 1 || packet.lease_ms > MAX_LEASE_MS || flags > 1) return false;
    return !packet.raw || (packet.speed >= -FULL_DUTY && packet.speed <= FULL_DUTY);
}

bool read_status(Fields& fields, Status& status) {
    const uint8_t number = fields.u8();
    status = static_cast<Status>(number);
    return number <= static_cast<uint8_t>(Status::not_written);
}

// A field without its flag is zero, so that a value has one spelling only.
bool read_telemetry(Fields& fields, Telemetry& t) {
    t.flags = fields.u8();
    t.session = fields.u16();
    t.faults = fields.u16();
    t.ticks = fields.u32();
    t.tick_period_us = fields.u32();
    t.speed_mm_s = fields.i16();
    t.steering_tenth_mrad = fields.i16();
    t.battery_mv = fields.u16();
    t.last_seq = fields.u16();
    t.last_age_us = fields.u16();
    t.chip_time_us = fields.u32();
    t.damaged_frames = fields.u16();
    using namespace telemetry_flags;
    return (t.flags & ~KNOWN) == 0 && ((t.flags & SESSION) || t.session == 0) &&
           ((t.flags & TICK_PERIOD) || t.tick_period_us == 0) && ((t.flags & BATTERY) || t.battery_mv == 0) &&
           ((t.flags & LAST_COMMAND) || (t.last_seq == 0 && t.last_age_us == 0));
}

}  // namespace

bool unstuff(uint8_t* bytes, uint8_t size, uint8_t& raw_size) {
    uint8_t from = 0;
    uint8_t to = 0;
    while (from < size) {
        // A run of 254 bytes without a zero, which has none after it, cannot occur: no frame is so long.
        const uint8_t run = bytes[from];
        if (run == 0 || run > size - from) return false;
        const uint8_t end = static_cast<uint8_t>(from + run);
        for (++from; from < end; ++from) bytes[to++] = bytes[from];
        if (from < size) bytes[to++] = 0;
    }
    raw_size = to;
    return true;
}

Heard parse(const uint8_t* raw, uint8_t size, HostPacket& packet) {
    const Heard heard = check(raw, size, size < HEADER_BYTES ? NO_SUCH_KIND : host_field_bytes(raw[1]));
    packet = HostPacket();
    if (heard == Heard::version) packet.kind = static_cast<Kind>(raw[1]);
    if (heard != Heard::packet) return heard;
    Fields fields(raw + 1, static_cast<uint8_t>(size - 1 - CRC_BYTES));
    packet.kind = static_cast<Kind>(fields.u8());
    packet.seq = fields.u16();
    switch (packet.kind) {
        case Kind::estop:
        case Kind::calibration_query: return heard;
        case Kind::parameter_read: packet.index = fields.u8(); return heard;
        case Kind::time_sync: packet.token = fields.u16(); return heard;
        default: break;
    }
    packet.session = fields.u16();
    switch (packet.kind) {
        case Kind::command: return read_command(fields, packet) ? heard : Heard::fields;
        case Kind::calibration_store: packet.crc = fields.u16(); return heard;
        case Kind::parameter_write:
            packet.index = fields.u8();
            packet.value = static_cast<int32_t>(fields.u32());
            return heard;
        default: return heard;
    }
}

Heard parse(const uint8_t* raw, uint8_t size, ChipPacket& packet) {
    const Heard heard = check(raw, size, size < HEADER_BYTES ? NO_SUCH_KIND : chip_field_bytes(raw[1]));
    packet = ChipPacket();
    if (heard == Heard::version) packet.kind = static_cast<Kind>(raw[1]);
    if (heard != Heard::packet) return heard;
    Fields fields(raw + 1, static_cast<uint8_t>(size - 1 - CRC_BYTES));
    packet.kind = static_cast<Kind>(fields.u8());
    packet.seq = fields.u16();
    switch (packet.kind) {
        case Kind::hello_ack:
            packet.hello_ack.session = fields.u16();
            packet.hello_ack.major = fields.u8();
            packet.hello_ack.minor = fields.u8();
            packet.hello_ack.patch = fields.u8();
            packet.hello_ack.capabilities = fields.u16();
            packet.hello_ack.calibration_crc = fields.u16();
            return heard;
        case Kind::telemetry: return read_telemetry(fields, packet.telemetry) ? heard : Heard::fields;
        case Kind::time_sync_ack:
            packet.time_sync_ack.token = fields.u16();
            packet.time_sync_ack.received_us = fields.u32();
            packet.time_sync_ack.sent_us = fields.u32();
            return heard;
        case Kind::parameter: {
            packet.parameter.index = fields.u8();
            const bool known = read_status(fields, packet.parameter.status);
            packet.parameter.value = static_cast<int32_t>(fields.u32());
            return known ? heard : Heard::fields;
        }
        default: {
            const bool known = read_status(fields, packet.calibration.status);
            packet.calibration.count = fields.u8();
            packet.calibration.crc_in_force = fields.u16();
            packet.calibration.crc_stored = fields.u16();
            return known ? heard : Heard::fields;
        }
    }
}

Wire::Wire(Kind kind, uint16_t seq, uint8_t version) : size_(FIELDS_AT) {
    u8(version).u8(static_cast<uint8_t>(kind)).u16(seq);
}

Wire& Wire::u8(uint8_t value) {
    // The last place is the zero's that ends the frame.
    if (size_ < LONGEST_WIRE_BYTES - 1) bytes_[size_++] = value;
    return *this;
}

Wire& Wire::u16(uint16_t value) {
    return u8(static_cast<uint8_t>(value)).u8(static_cast<uint8_t>(value >> 8));
}

Wire& Wire::u32(uint32_t value) {
    return u16(static_cast<uint16_t>(value)).u16(static_cast<uint16_t>(value >> 16));
}

void Wire::finish() {
    u16(crc16(bytes_ + FIELDS_AT, static_cast<uint8_t>(size_ - FIELDS_AT)));
    // Each zero becomes the distance to the next; no frame is long enough for a run of 254.
    uint8_t zero_at = FIELDS_AT - 1;
    for (uint8_t at = FIELDS_AT; at < size_; ++at) {
        if (bytes_[at] != 0) continue;
        bytes_[zero_at] = static_cast<uint8_t>(at - zero_at);
        zero_at = at;
    }
    bytes_[zero_at] = static_cast<uint8_t>(size_ - zero_at);
    bytes_[0] = 0;
    bytes_[size_++] = 0;
}

void write(Wire& wire, const HelloAck& ack) {
    wire.u16(ack.session).u8(ack.major).u8(ack.minor).u8(ack.patch).u16(ack.capabilities).u16(ack.calibration_crc);
}

void write(Wire& wire, const Telemetry& t) {
    wire.u8(t.flags).u16(t.session).u16(t.faults).u32(t.ticks).u32(t.tick_period_us);
    wire.u16(static_cast<uint16_t>(t.speed_mm_s)).u16(static_cast<uint16_t>(t.steering_tenth_mrad));
    wire.u16(t.battery_mv).u16(t.last_seq).u16(t.last_age_us).u32(t.chip_time_us).u16(t.damaged_frames);
}

void write(Wire& wire, const TimeSyncAck& ack) { wire.u16(ack.token).u32(ack.received_us).u32(ack.sent_us); }

void write(Wire& wire, const ParameterAnswer& answer) {
    wire.u8(answer.index).u8(static_cast<uint8_t>(answer.status)).u32(static_cast<uint32_t>(answer.value));
}

void write(Wire& wire, const CalibrationAnswer& answer) {
    wire.u8(static_cast<uint8_t>(answer.status)).u8(answer.count).u16(answer.crc_in_force).u16(answer.crc_stored);
}

void write(Wire& wire, const HostPacket& packet) {
    switch (packet.kind) {
        case Kind::estop:
        case Kind::calibration_query: return;
        case Kind::parameter_read: wire.u8(packet.index); return;
        case Kind::time_sync: wire.u16(packet.token); return;
        default: wire.u16(packet.session); break;
    }
    switch (packet.kind) {
        case Kind::command:
            wire.u16(static_cast<uint16_t>(packet.steering_tenth_mrad)).u16(static_cast<uint16_t>(packet.speed));
            wire.u16(packet.lease_ms).u8(packet.raw ? 1 : 0);
            return;
        case Kind::parameter_write: wire.u8(packet.index).u32(static_cast<uint32_t>(packet.value)); return;
        case Kind::calibration_store: wire.u16(packet.crc); return;
        default: return;
    }
}

}  // namespace carril
