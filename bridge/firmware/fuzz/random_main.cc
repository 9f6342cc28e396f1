// Stands in for libFuzzer where there is no clang: calls the fuzz target with random bytes for `-max_total_time=` seconds. Finds
// less than libFuzzer, because it does not learn from what it has tried.
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <chrono>
#include <random>
#include <vector>

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size);

int main(int argc, char** argv) {
    long seconds = 60;
    long longest = 600;
    for (int i = 1; i < argc; ++i) {
        sscanf(argv[i], "-max_total_time=%ld", &seconds);
        sscanf(argv[i], "-max_len=%ld", &longest);
    }
    const auto end = std::chrono::steady_clock::now() + std::chrono::seconds(seconds);
    const unsigned seed = std::random_device()();
    printf("seed %u\n", seed);
    fflush(stdout);
    std::mt19937 random(seed);
    unsigned long runs = 0;
    for (; std::chrono::steady_clock::now() < end; ++runs) {
        std::vector<uint8_t> bytes(random() % static_cast<unsigned long>(longest));
        // Zeros end frames: sometimes many of them.
        const unsigned zeros = random() % 16;
        for (uint8_t& byte : bytes) byte = static_cast<uint8_t>(random() % 16 < zeros / 2 ? 0 : random());
        LLVMFuzzerTestOneInput(bytes.data(), bytes.size());
    }
    printf("%lu runs\n", runs);
    return 0;
}
