// The frames of bridge/protocol.md: their fields, their bytes, and what makes them invalid. Knows nothing of time, sessions or
// pins, and never keeps a byte.
#pragma once

#include <stdint.h>

namespace carril {

constexpr uint8_t PROTOCOL_VERSION = 1;
// From version to crc, B.
constexpr uint8_t MAX_RAW_BYTES = 60;
// Stuffing adds one, B.
constexpr uint8_t MAX_STUFFED_BYTES = MAX_RAW_BYTES + 1;
// The longest frame of version 1 (telemetry) with its two zeros, B.
constexpr uint8_t LONGEST_WIRE_BYTES = 38;
constexpr uint16_t MAX_LEASE_MS = 2000;
// `speed` of a raw command: duty in 1/1020, because the car's stock firmware counts so.
constexpr int16_t FULL_DUTY = 1020;

enum class Kind : uint8_t {
    hello = 0x01,
    command = 0x02,
    estop = 0x03,
    fault_clear = 0x04,
    release = 0x05,
    time_sync = 0x06,
    parameter_read = 0x10,
    parameter_write = 0x11,
    calibration_store = 0x12,
    calibration_defaults = 0x13,
    calibration_query = 0x14,
    hello_ack = 0x81,
    telemetry = 0x82,
    time_sync_ack = 0x83,
    parameter = 0x90,
    calibration = 0x91,
};

enum class Status : uint8_t {
    done = 0,
    no_such_parameter = 1,
    out_of_range = 2,
    driving = 3,
    not_the_open_session = 4,
    crc_differs = 5,
    not_written = 6,
};

// What a decoder makes of the bytes so far.
enum class Heard : uint8_t {
    nothing,  // no frame has ended
    packet,
    too_long,
    stuffing,
    checksum,
    version,
    kind,
    fields,
};

// A frame from the host. Fields that its kind does not have are 0.
struct HostPacket {
    Kind kind;
    uint16_t seq;
    uint16_t session;
    int16_t steering_tenth_mrad;
    int16_t speed;  // mm/s; of a raw command 1/1020 of full duty
    uint16_t lease_ms;
    bool raw;
    uint16_t token;
    uint8_t index;
    int32_t value;
    uint16_t crc;
};

struct HelloAck {
    uint16_t session;
    uint8_t major;
    uint8_t minor;
    uint8_t patch;
    uint16_t capabilities;
    uint16_t calibration_crc;
};

namespace telemetry_flags {
constexpr uint8_t DRIVING = 1 << 0;
constexpr uint8_t SESSION = 1 << 1;
constexpr uint8_t TICK_PERIOD = 1 << 2;
constexpr uint8_t BATTERY = 1 << 3;
constexpr uint8_t LAST_COMMAND = 1 << 4;
constexpr uint8_t KNOWN = 0x1F;
}  // namespace telemetry_flags

struct Telemetry {
    uint8_t flags;
    uint16_t session;
    uint16_t faults;
    uint32_t ticks;
    uint32_t tick_period_us;
    int16_t speed_mm_s;
    int16_t steering_tenth_mrad;
    uint16_t battery_mv;
    uint16_t last_seq;
    uint16_t last_age_us;
    uint32_t chip_time_us;
    uint16_t damaged_frames;
};

struct TimeSyncAck {
    uint16_t token;
    uint32_t received_us;
    uint32_t sent_us;
};

struct ParameterAnswer {
    uint8_t index;
    Status status;
    int32_t value;
};

struct CalibrationAnswer {
    Status status;
    uint8_t count;
    uint16_t crc_in_force;
    uint16_t crc_stored;
};

// A frame from the chip: the fields of its kind count.
struct ChipPacket {
    Kind kind;
    uint16_t seq;
    HelloAck hello_ack;
    Telemetry telemetry;
    TimeSyncAck time_sync_ack;
    ParameterAnswer parameter;
    CalibrationAnswer calibration;
};

// Undoes the byte stuffing of `size` bytes without a zero, in place. False when it does not come out even.
bool unstuff(uint8_t* bytes, uint8_t size, uint8_t& raw_size);

// Reads a frame from version to crc. `packet` holds something only when the answer is `packet`; of a frame of another version
// it holds the number of the kind.
Heard parse(const uint8_t* raw, uint8_t size, HostPacket& packet);
Heard parse(const uint8_t* raw, uint8_t size, ChipPacket& packet);

// A frame as it goes over the line. Fields are put in one after the other; `finish` makes the bytes ready.
class Wire {
public:
    Wire(Kind kind, uint16_t seq, uint8_t version = PROTOCOL_VERSION);

    Wire& u8(uint8_t value);
    Wire& u16(uint16_t value);
    Wire& u32(uint32_t value);
    // Adds the checksum, stuffs the bytes and puts a zero on either side.
    void finish();

    const uint8_t* bytes() const { return bytes_; }
    uint8_t size() const { return size_; }

private:
    // The zero before the frame and the first byte of the stuffing stand in front of the fields.
    static constexpr uint8_t FIELDS_AT = 2;
    uint8_t bytes_[LONGEST_WIRE_BYTES];
    uint8_t size_;
};

void write(Wire& wire, const HelloAck& ack);
void write(Wire& wire, const Telemetry& telemetry);
void write(Wire& wire, const TimeSyncAck& ack);
void write(Wire& wire, const ParameterAnswer& answer);
void write(Wire& wire, const CalibrationAnswer& answer);
// The host's side of the line; the firmware itself does not need it.
void write(Wire& wire, const HostPacket& packet);

}  // namespace carril
