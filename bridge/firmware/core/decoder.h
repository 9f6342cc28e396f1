// Finds frames in a stream of bytes. After any damage it is back in step at the next zero. Holds one frame's bytes and never
// more, and counts what it refuses by kind.
#pragma once

#include "frame.h"

namespace carril {

// Refused frames by kind of damage; all wrap.
struct DamageCounts {
    uint16_t too_long = 0;
    uint16_t stuffing = 0;
    uint16_t checksum = 0;
    uint16_t version = 0;
    uint16_t kind = 0;
    uint16_t fields = 0;

    uint16_t total() const { return static_cast<uint16_t>(too_long + stuffing + checksum + version + kind + fields); }

    void count(Heard heard) {
        switch (heard) {
            case Heard::too_long: ++too_long; break;
            case Heard::stuffing: ++stuffing; break;
            case Heard::checksum: ++checksum; break;
            case Heard::version: ++version; break;
            case Heard::kind: ++kind; break;
            case Heard::fields: ++fields; break;
            case Heard::nothing:
            case Heard::packet: break;
        }
    }
};

// `Packet` is HostPacket on the chip and ChipPacket on the host.
template <class Packet>
class Decoder {
public:
    // Takes one byte; at the end of a frame says what it was.
    Heard push(uint8_t byte, Packet& packet) {
        if (byte != 0) {
            if (size_ < MAX_STUFFED_BYTES) bytes_[size_] = byte;
            if (size_ <= MAX_STUFFED_BYTES) ++size_;
            return Heard::nothing;
        }
        if (size_ == 0) return Heard::nothing;
        const Heard heard = decode(packet);
        damage_.count(heard);
        size_ = 0;
        return heard;
    }

    const DamageCounts& damage() const { return damage_; }

private:
    Heard decode(Packet& packet) {
        uint8_t raw_size = 0;
        if (size_ > MAX_STUFFED_BYTES) return Heard::too_long;
        if (!unstuff(bytes_, size_, raw_size)) return Heard::stuffing;
        return parse(bytes_, raw_size, packet);
    }

    uint8_t bytes_[MAX_STUFFED_BYTES] = {};
    // Since the last zero; one more than there is room for says that there were too many.
    uint8_t size_ = 0;
    DamageCounts damage_;
};

}  // namespace carril
