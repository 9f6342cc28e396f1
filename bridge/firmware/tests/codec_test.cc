// The language of the line: the vectors, each kind both ways, and damage of every sort.
#include <doctest/doctest.h>
#include <stdlib.h>

#include <random>

#include "bench.h"
#include "vectors.h"

using namespace carril;

namespace {

using Values = std::map<std::string, std::string>;

bool thorough() { return getenv("CARRIL_THOROUGH") != nullptr; }

long number(const Values& values, const std::string& name) {
    const auto found = values.find(name);
    REQUIRE_MESSAGE(found != values.end(), "the vector has no field ", name);
    return found->second == "-" ? 0 : std::stol(found->second);
}

bool has(const Values& values, const std::string& name) {
    const auto found = values.find(name);
    return found != values.end() && found->second != "-";
}

template <class T>
T field(const Values& values, const std::string& name) {
    return static_cast<T>(number(values, name));
}

bool host_packet(const std::string& kind, const Values& v, HostPacket& packet) {
    static const std::map<std::string, Kind> kinds = {
        {"hello", Kind::hello}, {"command", Kind::command}, {"estop", Kind::estop}, {"fault_clear", Kind::fault_clear},
        {"release", Kind::release}, {"time_sync", Kind::time_sync}, {"parameter_read", Kind::parameter_read},
        {"parameter_write", Kind::parameter_write}, {"calibration_store", Kind::calibration_store},
        {"calibration_defaults", Kind::calibration_defaults}, {"calibration_query", Kind::calibration_query}};
    const auto found = kinds.find(kind);
    if (found == kinds.end()) return false;
    packet = packet_of(found->second);
    packet.seq = field<uint16_t>(v, "seq");
    if (v.count("session")) packet.session = field<uint16_t>(v, "session");
    if (v.count("token")) packet.token = field<uint16_t>(v, "token");
    if (v.count("index")) packet.index = field<uint8_t>(v, "index");
    if (v.count("value")) packet.value = field<int32_t>(v, "value");
    if (v.count("crc")) packet.crc = field<uint16_t>(v, "crc");
    if (packet.kind == Kind::command) {
        packet.raw = v.count("duty") != 0;
        packet.steering_tenth_mrad = field<int16_t>(v, "steering_tenth_mrad");
        packet.speed = field<int16_t>(v, packet.raw ? "duty" : "speed_mm_s");
        packet.lease_ms = field<uint16_t>(v, "lease_ms");
    }
    return true;
}

Bytes chip_wire(const std::string& kind, const Values& v) {
    const uint16_t seq = field<uint16_t>(v, "seq");
    if (kind == "hello_ack") {
        unsigned major, minor, patch;
        REQUIRE(sscanf(v.at("firmware").c_str(), "%u.%u.%u", &major, &minor, &patch) == 3);
        return wire_of(Kind::hello_ack, seq,
                       HelloAck{field<uint16_t>(v, "session"), static_cast<uint8_t>(major), static_cast<uint8_t>(minor),
                                static_cast<uint8_t>(patch), field<uint16_t>(v, "capabilities"),
                                field<uint16_t>(v, "calibration_crc")});
    }
    if (kind == "time_sync_ack") {
        return wire_of(Kind::time_sync_ack, seq,
                       TimeSyncAck{field<uint16_t>(v, "token"), field<uint32_t>(v, "received_us"), field<uint32_t>(v, "sent_us")});
    }
    if (kind == "parameter") {
        return wire_of(Kind::parameter, seq,
                       ParameterAnswer{field<uint8_t>(v, "index"), field<Status>(v, "status"), field<int32_t>(v, "value")});
    }
    if (kind == "calibration") {
        return wire_of(Kind::calibration, seq,
                       CalibrationAnswer{field<Status>(v, "status"), field<uint8_t>(v, "count"),
                                         field<uint16_t>(v, "crc_in_force"), field<uint16_t>(v, "crc_stored")});
    }
    REQUIRE_MESSAGE(kind == "telemetry", "a kind that this test does not know: ", kind);
    using namespace telemetry_flags;
    Telemetry t = {};
    t.flags = static_cast<uint8_t>((number(v, "driving") ? DRIVING : 0) | (has(v, "session") ? telemetry_flags::SESSION : 0) |
                                   (has(v, "tick_period_us") ? TICK_PERIOD : 0) | (has(v, "battery_mv") ? BATTERY : 0) |
                                   (has(v, "last_seq") ? LAST_COMMAND : 0));
    t.session = field<uint16_t>(v, "session");
    t.faults = field<uint16_t>(v, "faults");
    t.ticks = field<uint32_t>(v, "ticks");
    t.tick_period_us = field<uint32_t>(v, "tick_period_us");
    t.speed_mm_s = field<int16_t>(v, "speed_mm_s");
    t.steering_tenth_mrad = field<int16_t>(v, "steering_tenth_mrad");
    t.battery_mv = field<uint16_t>(v, "battery_mv");
    t.last_seq = field<uint16_t>(v, "last_seq");
    t.last_age_us = field<uint16_t>(v, "last_age_us");
    t.chip_time_us = field<uint32_t>(v, "chip_time_us");
    t.damaged_frames = field<uint16_t>(v, "damaged_frames");
    return wire_of(Kind::telemetry, seq, t);
}

// One spelling per value: a packet is what its bytes are.
Bytes wire_of_any(const ChipPacket& packet) {
    switch (packet.kind) {
        case Kind::hello_ack: return wire_of(packet.kind, packet.seq, packet.hello_ack);
        case Kind::telemetry: return wire_of(packet.kind, packet.seq, packet.telemetry);
        case Kind::time_sync_ack: return wire_of(packet.kind, packet.seq, packet.time_sync_ack);
        case Kind::parameter: return wire_of(packet.kind, packet.seq, packet.parameter);
        default: return wire_of(packet.kind, packet.seq, packet.calibration);
    }
}
Bytes wire_of_any(const HostPacket& packet) { return wire_of(packet); }

std::string name_of(Heard heard) {
    switch (heard) {
        case Heard::too_long: return "too_long";
        case Heard::stuffing: return "stuffing";
        case Heard::checksum: return "checksum";
        case Heard::version: return "version";
        case Heard::kind: return "kind";
        case Heard::fields: return "fields";
        default: return "accepted";
    }
}

std::vector<Bytes> frames_of(bool host) {
    std::vector<Bytes> frames;
    for (const auto& line : vector_lines("frames.txt")) {
        HostPacket packet;
        Values values;
        for (size_t i = 2; i < line.size(); ++i) {
            const size_t equals = line[i].find('=');
            values[line[i].substr(0, equals)] = line[i].substr(equals + 1);
        }
        if (host_packet(line[1], values, packet) == host) frames.push_back(bytes_of_hex(line[0]));
    }
    return frames;
}

template <class Packet>
void refuses_every_flip(const std::vector<Bytes>& frames) {
    REQUIRE(!frames.empty());
    for (const Bytes& frame : frames) {
        const size_t bits = 8 * frame.size();
        // The same packet as before is no wrong packet: flips of a zero around the frame may leave it whole.
        const auto check = [&frame](const Bytes& damaged, size_t one, size_t other) {
            for (const Packet& packet : read_all<Packet>(damaged).packets) {
                const bool same = wire_of_any(packet) == frame;
                CHECK_MESSAGE(same, "bits ", one, " and ", other, " flipped make another frame");
            }
        };
        for (size_t one = 0; one < bits; ++one) {
            Bytes damaged = frame;
            damaged[one / 8] ^= static_cast<uint8_t>(1 << one % 8);
            check(damaged, one, one);
            for (size_t other = one + 1; other < bits; ++other) {
                damaged[other / 8] ^= static_cast<uint8_t>(1 << other % 8);
                check(damaged, one, other);
                damaged[other / 8] ^= static_cast<uint8_t>(1 << other % 8);
            }
        }
    }
}

// Damages a frame in one of six ways: one flipped bit, two, a cut, a lost byte, a burst of further bytes, or lost zeros, so that it
// runs into its neighbours. More at once finds the limit of any checksum of 16 bits: of what then looks like a frame, with a kind
// and the size of that kind, one in 65 536 passes.
void damage(Bytes& bytes, std::mt19937& random) {
    const auto below = [&random](size_t end) { return static_cast<size_t>(random() % end); };
    const auto place = [&below, &bytes](size_t end) { return bytes.begin() + static_cast<long>(below(end)); };
    const size_t way = below(6);
    switch (way) {
        case 0:
        case 1:
            for (size_t flips = 0; flips <= way; ++flips) *place(bytes.size()) ^= static_cast<uint8_t>(1 << below(8));
            break;
        case 2: bytes.resize(below(bytes.size())); break;
        case 3: bytes.erase(place(bytes.size())); break;
        case 4:
            for (size_t more = 1 + below(7); more > 0; --more) bytes.insert(place(bytes.size() + 1), static_cast<uint8_t>(random()));
            break;
        default: bytes = Bytes(bytes.begin() + 1, bytes.end() - 1);
    }
}

// Good frames with damaged ones in between. All good ones must come through, and nothing that was not sent.
template <class Packet>
void stays_in_step(const std::vector<Bytes>& frames, unsigned seed) {
    REQUIRE(!frames.empty());
    std::mt19937 random(seed);
    // Half a million each way are the million.
    const unsigned rounds = thorough() ? 500000 : 25000;
    const auto random_frame = [&frames, &random] {
        Packet packet = read_all<Packet>(frames[random() % frames.size()]).packets[0];
        packet.seq = static_cast<uint16_t>(random());
        return wire_of_any(packet);
    };
    Decoder<Packet> decoder;
    for (unsigned round = 0; round < rounds; ++round) {
        const Bytes sent[] = {random_frame(), random_frame(), random_frame()};
        Bytes damaged = sent[1];
        damage(damaged, random);
        Bytes all = sent[0];
        all.insert(all.end(), damaged.begin(), damaged.end());
        all.insert(all.end(), sent[2].begin(), sent[2].end());
        Bytes last;
        for (const uint8_t byte : all) {
            Packet packet = {};
            if (decoder.push(byte, packet) != Heard::packet) continue;
            last = wire_of_any(packet);
            const bool was_sent = last == sent[0] || last == sent[1] || last == sent[2];
            CHECK_MESSAGE(was_sent, "round ", round, ": a damaged frame was taken for another");
        }
        REQUIRE_MESSAGE(last == sent[2], "round ", round, ": the frame after the damage is lost");
    }
    CHECK(decoder.damage().total() != 0);
}

}  // namespace

TEST_CASE("the checksum is CRC-16/IBM-3740") {
    const uint8_t digits[] = {'1', '2', '3', '4', '5', '6', '7', '8', '9'};
    CHECK(crc16(digits, sizeof digits) == 0x29B1);
    CHECK(crc16(digits, 0) == 0xFFFF);
}

TEST_CASE("decodes and encodes every frame of the vectors") {
    const auto lines = vector_lines("frames.txt");
    REQUIRE_MESSAGE(lines.size() >= 17, "bridge/vectors/frames.txt is not there or too short");
    for (const auto& line : lines) {
        CAPTURE(line[0]);
        const Bytes bytes = bytes_of_hex(line[0]);
        Values values;
        for (size_t i = 2; i < line.size(); ++i) {
            const size_t equals = line[i].find('=');
            values[line[i].substr(0, equals)] = line[i].substr(equals + 1);
        }
        HostPacket packet;
        if (host_packet(line[1], values, packet)) {
            CHECK(wire_of(packet) == bytes);
            const auto read = read_all<HostPacket>(bytes);
            REQUIRE(read.packets.size() == 1);
            CHECK(wire_of(read.packets[0]) == bytes);
            CHECK(read.packets[0].seq == packet.seq);
            CHECK(read.packets[0].raw == packet.raw);
            CHECK(read.packets[0].speed == packet.speed);
            CHECK(read.packets[0].value == packet.value);
        } else {
            CHECK(chip_wire(line[1], values) == bytes);
            const auto read = read_all<ChipPacket>(bytes);
            REQUIRE(read.packets.size() == 1);
            CHECK(wire_of_any(read.packets[0]) == bytes);
        }
    }
}

TEST_CASE("refuses every damaged vector and counts it where it belongs") {
    const auto lines = vector_lines("damaged.txt");
    REQUIRE_MESSAGE(lines.size() >= 20, "bridge/vectors/damaged.txt is not there or too short");
    for (const auto& line : lines) {
        CAPTURE(line[0]);
        const Bytes bytes = bytes_of_hex(line[0]);
        const bool host = line[1] == "host";
        const auto from_host = read_all<HostPacket>(bytes);
        const auto from_chip = read_all<ChipPacket>(bytes);
        CHECK((host ? from_host.packets.size() : from_chip.packets.size()) == 0);
        const auto& refusals = host ? from_host.refusals : from_chip.refusals;
        REQUIRE(refusals.size() == 1);
        CHECK(name_of(refusals[0]) == line[2]);
        CHECK((host ? from_host.damage : from_chip.damage).total() == 1);
    }
}

TEST_CASE("each new kind has the bytes of the protocol's table") {
    // Made by hand from bridge/protocol.md, without checksum and stuffing.
    struct Case {
        HostPacket packet;
        Bytes raw;
    };
    HostPacket sync = packet_of(Kind::time_sync);
    sync.token = 0xBEEF;
    HostPacket raw = raw_command(OUR_SESSION, -1020, 200);
    raw.steering_tenth_mrad = -2;
    const std::vector<Case> cases = {
        {raw, {1, 0x02, 0, 0, 0x34, 0x12, 0xFE, 0xFF, 0x04, 0xFC, 200, 0, 1}},
        {sync, {1, 0x06, 0, 0, 0xEF, 0xBE}},
        {parameter_read(23), {1, 0x10, 0, 0, 23}},
        {parameter_write(OUR_SESSION, Parameter::servo_left_us, -2), {1, 0x11, 0, 0, 0x34, 0x12, 3, 0xFE, 0xFF, 0xFF, 0xFF}},
        {calibration_store(OUR_SESSION, 0xBEEF), {1, 0x12, 0, 0, 0x34, 0x12, 0xEF, 0xBE}},
        {packet_of(Kind::calibration_defaults, OUR_SESSION), {1, 0x13, 0, 0, 0x34, 0x12}},
        {packet_of(Kind::calibration_query), {1, 0x14, 0, 0}},
    };
    for (const Case& one : cases) {
        Bytes wire = wire_of(one.packet);
        uint8_t size = 0;
        REQUIRE(unstuff(wire.data() + 1, static_cast<uint8_t>(wire.size() - 2), size));
        CHECK(Bytes(wire.begin() + 1, wire.begin() + 1 + size - 2) == one.raw);
    }
}

TEST_CASE("a field out of range is refused") {
    const auto refused = [](const HostPacket& packet) {
        const auto read = read_all<HostPacket>(wire_of(packet));
        return read.packets.empty() && read.damage.fields == 1;
    };
    CHECK(refused(command(1, 0, 0)));
    CHECK(refused(command(1, 0, 2001)));
    CHECK(!refused(command(1, INT16_MIN, 2000)));
    CHECK(refused(raw_command(1, 1021, 100)));
    CHECK(refused(raw_command(1, -1021, 100)));
    CHECK(!refused(raw_command(1, -1020, 100)));
    const auto read = read_all<ChipPacket>(wire_of(Kind::parameter, 0, ParameterAnswer{0, static_cast<Status>(7), 0}));
    CHECK(read.damage.fields == 1);
}

TEST_CASE("the longest frame fits, and one byte more is too long") {
    Bytes bytes(MAX_STUFFED_BYTES, 0x55);
    bytes.push_back(0);
    CHECK(read_all<HostPacket>(bytes).damage.stuffing == 1);
    bytes.insert(bytes.begin(), 0x55);
    CHECK(read_all<HostPacket>(bytes).damage.too_long == 1);
    Telemetry t = {};
    t.flags = telemetry_flags::KNOWN;
    t.ticks = t.tick_period_us = t.chip_time_us = UINT32_MAX;
    t.session = t.faults = t.battery_mv = t.last_seq = t.last_age_us = t.damaged_frames = UINT16_MAX;
    t.speed_mm_s = t.steering_tenth_mrad = -1;
    const Bytes longest = wire_of(Kind::telemetry, 0xFFFF, t);
    CHECK(longest.size() == LONGEST_WIRE_BYTES);
    CHECK(read_all<ChipPacket>(longest).packets.size() == 1);
}

TEST_CASE("is back in step at the next zero, after any length of noise") {
    for (size_t length : {1UL, 61UL, 62UL, 255UL, 256UL, 257UL, 511UL, 512UL, 10000UL}) {
        Bytes bytes(length, 0x55);
        const Bytes good = wire_of(hello(OUR_SESSION));
        bytes.insert(bytes.end(), good.begin(), good.end());
        const auto read = read_all<HostPacket>(bytes);
        CHECK_MESSAGE(read.packets.size() == 1, length, " bytes of noise");
        CHECK(read.damage.total() == 1);
    }
}

TEST_CASE("every flip of one or two bits of every vector is refused") {
    refuses_every_flip<HostPacket>(frames_of(true));
    refuses_every_flip<ChipPacket>(frames_of(false));
}

TEST_CASE("a million damaged frames: none is taken for another, and the next good one is heard") {
    stays_in_step<HostPacket>(frames_of(true), 1);
    stays_in_step<ChipPacket>(frames_of(false), 2);
}
