// The inserter alone as a library: samples in, a clock each, samples out.
#include <cstdint>

#include "Vinserter.h"
#include "verilated.h"

extern "C" {

// All arrays of n samples; the lines of the first sample are held before it until the delay line is full.
// Gives the latency: sample i of the lines goes out at clock i + latency.
int inserter_run(int64_t n, int separation, const uint8_t* a, const uint8_t* b, const uint8_t* z, const int32_t* target,
                 int whole_cycles, uint32_t interval, uint8_t* a_out, uint8_t* b_out, uint8_t* z_out, int32_t* ledger) {
  VerilatedContext context;
  Vinserter top(&context);
  auto clock = [&] {
    top.clk = 0;
    top.eval();
    top.clk = 1;
    top.eval();
  };
  top.whole_cycles = whole_cycles;
  top.interval = interval;
  top.clear_fault = 0;
  top.hold = 0;
  top.a = a[0];
  top.b = b[0];
  top.z = z[0];
  top.target = 0;
  top.rst = 1;
  for (int i = 0; i < 2 * separation + 4; ++i) clock();
  top.rst = 0;
  for (int i = 0; i < 2 * separation + 4; ++i) clock();
  // The sample that is decided in a clock came in `separation` clocks before; its target three clocks before.
  const int late = separation, early = 3;
  for (int64_t i = 0; i < n + late; ++i) {
    const int64_t in = i < n ? i : n - 1;
    top.a = a[in];
    top.b = b[in];
    top.z = z[in];
    if (i >= late - early) top.target = target[i - late + early < n ? i - late + early : n - 1];
    clock();
    if (i >= late) {
      a_out[i - late] = top.a_out;
      b_out[i - late] = top.b_out;
      z_out[i - late] = top.z_out;
    }
  }
  ledger[0] = top.raw;
  ledger[1] = top.inserted;
  top.final();
  return late;
}
}
