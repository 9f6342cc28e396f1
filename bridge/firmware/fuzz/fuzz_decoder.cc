// Fuzzes both decoders with any bytes: no crash, and what is accepted has one spelling: encoded again it is a frame of the same
// fields.
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "../core/decoder.h"

namespace {

using namespace carril;

template <class Packet, class Encode>
void run(const uint8_t* data, size_t size, Encode encode) {
    Decoder<Packet> decoder;
    for (size_t i = 0; i < size; ++i) {
        Packet packet = {};
        if (decoder.push(data[i], packet) != Heard::packet) continue;
        Decoder<Packet> again;
        Packet same = {};
        unsigned heard = 0;
        const Wire wire = encode(packet);
        for (uint8_t at = 0; at < wire.size(); ++at) {
            if (again.push(wire.bytes()[at], same) == Heard::packet) ++heard;
        }
        if (heard != 1 || same.kind != packet.kind || same.seq != packet.seq) abort();
    }
}

Wire from_host(const HostPacket& packet) {
    Wire wire(packet.kind, packet.seq);
    write(wire, packet);
    wire.finish();
    return wire;
}

Wire from_chip(const ChipPacket& packet) {
    Wire wire(packet.kind, packet.seq);
    switch (packet.kind) {
        case Kind::hello_ack: write(wire, packet.hello_ack); break;
        case Kind::telemetry: write(wire, packet.telemetry); break;
        case Kind::time_sync_ack: write(wire, packet.time_sync_ack); break;
        case Kind::parameter: write(wire, packet.parameter); break;
        default: write(wire, packet.calibration); break;
    }
    wire.finish();
    return wire;
}

}  // namespace

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
    run<HostPacket>(data, size, from_host);
    run<ChipPacket>(data, size, from_chip);
    return 0;
}
