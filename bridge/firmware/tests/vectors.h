// Reads bridge/vectors, which both sides of the line test against.
#pragma once

#include <stdint.h>

#include <fstream>
#include <map>
#include <sstream>
#include <string>
#include <vector>

#include "../core/decoder.h"

namespace carril {

inline std::vector<std::vector<std::string>> vector_lines(const std::string& name) {
    const char* folder = getenv("CARRIL_VECTORS");
    std::ifstream file(std::string(folder ? folder : "../vectors") + "/" + name);
    std::vector<std::vector<std::string>> lines;
    std::string line;
    while (std::getline(file, line)) {
        if (line.empty() || line[0] == '#') continue;
        std::istringstream words(line);
        std::vector<std::string> fields;
        std::string word;
        while (words >> word) fields.push_back(word);
        lines.push_back(fields);
    }
    return lines;
}

inline std::vector<uint8_t> bytes_of_hex(const std::string& hex) {
    std::vector<uint8_t> bytes;
    for (size_t i = 0; i + 1 < hex.size(); i += 2) {
        bytes.push_back(static_cast<uint8_t>(std::stoul(hex.substr(i, 2), nullptr, 16)));
    }
    return bytes;
}

// What a decoder said of some bytes.
template <class Packet>
struct Reading {
    std::vector<Packet> packets;
    std::vector<Heard> refusals;
    DamageCounts damage;
};

template <class Packet>
Reading<Packet> read_all(const std::vector<uint8_t>& bytes) {
    Decoder<Packet> decoder;
    Reading<Packet> reading;
    for (const uint8_t byte : bytes) {
        Packet packet = {};
        const Heard heard = decoder.push(byte, packet);
        if (heard == Heard::nothing) continue;
        if (heard == Heard::packet) {
            reading.packets.push_back(packet);
        } else {
            reading.refusals.push_back(heard);
        }
    }
    reading.damage = decoder.damage();
    return reading;
}

}  // namespace carril
