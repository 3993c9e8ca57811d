// The gateware as a library: encoders that move, a controller that counts, bytes on the line, clock by clock.
//
// The controller's counts are decoded from the lines that go out, by a decoder that shares nothing with the gateware.
// AXES, CLK_HZ, BAUD and SPI are those of the build (Makefile).
#include <cstdint>
#include <cstring>
#include <deque>
#include <vector>

#include "Vchip.h"
#include "Vchip___024root.h"
#include "verilated.h"
#if VM_COVERAGE
#include "verilated_cov.h"
#endif

namespace {

constexpr int kGray[4] = {0, 1, 3, 2};   // phase to lines, A in bit 0
constexpr int kPhase[4] = {0, 1, 3, 2};  // and back
constexpr int kDivisor = CLK_HZ / BAUD;
constexpr int kRest = 16;           // clocks: when nothing has moved in the link for so long, nothing will by itself
constexpr int64_t kFarthest = 20000;  // counts that are walked edge by edge; see go()

struct Controller {
  int last = -1;
  int64_t counts = 0;
  int64_t illegal = 0;
  int64_t since = 1 << 30;    // clocks since the last edge
  int64_t closest = 1 << 30;  // least clocks between two edges
  void see(int lines) {
    const int phase = kPhase[lines];
    ++since;
    if (last >= 0 && phase != last) {
      const int step = (phase - last) & 3;
      if (step == 2) ++illegal;
      else counts += step == 1 ? 1 : -1;
      if (since < closest) closest = since;
      since = 0;
    }
    last = phase;
  }
};

int32_t word(const VlWide<3>& wide, int i) { return static_cast<int32_t>(wide[i]); }
template <typename T> int32_t word(const T& narrow, int i) { return static_cast<int32_t>(narrow >> (32 * i)); }

}  // namespace

struct Chip {
  VerilatedContext context;
  Vchip top{&context};
  uint64_t clocks = 0;
  int64_t position[AXES] = {};
  Controller controller[AXES];
  bool frozen = false;  // its clock in microseconds is stuck
  uint16_t last_command = 0;
  uint64_t commands = 0;
  // serial line, as a port on the other side drives and reads it
  std::deque<uint8_t> to_box;
  int sending = 0, send_bits = 0;
  double send_wait = 1, bit_clocks = kDivisor;  // the other side has a clock of its own
  int glitch = 0;                               // clocks for which the line is low, whatever is sent
  std::vector<uint8_t> from_box;
  int got = 0, got_wait = 0, got_bits = 0;

  static int line(const uint32_t mask, int axis) { return (mask >> axis) & 1; }

  void clock() {
    if (!SPI) drive_line();
    const uint32_t time_us = top.rootp->chip__DOT__core__DOT__watch__DOT__time_us;
    top.clk = 0;
    top.eval();
    top.clk = 1;
    top.eval();
    ++clocks;
    if (frozen) top.rootp->chip__DOT__core__DOT__watch__DOT__time_us = time_us;
    if (const uint16_t now = top.rootp->chip__DOT__core__DOT__line__DOT__last_command; now != last_command) {
      last_command = now;
      commands += !top.rst;
    }
    if (!SPI) read_line();
    if (!top.rst)
      for (int i = 0; i < AXES; ++i) controller[i].see(line(top.a_out, i) | line(top.b_out, i) << 1);
  }

  void drive_line() {
    if (glitch > 0) { --glitch; top.rx = 0; return; }
    if (--send_wait > 0) return;
    if (send_bits == 0) {
      if (to_box.empty()) { top.rx = 1; send_wait = 1; return; }
      sending = 0x200 | to_box.front() << 1;
      to_box.pop_front();
      send_bits = 10;
    }
    top.rx = sending & 1;
    sending >>= 1;
    --send_bits;
    send_wait += bit_clocks;
  }

  void read_line() {
    if (got_bits == 0) {
      if (!top.tx) { got_bits = 9; got_wait = kDivisor + kDivisor / 2 - 1; got = 0; }
      return;
    }
    if (got_wait-- > 0) return;
    got_wait = kDivisor - 1;
    if (--got_bits == 0) { if (top.tx) from_box.push_back(static_cast<uint8_t>(got)); }
    else got = got >> 1 | (top.tx ? 0x80 : 0);
  }

  // Is something on its way into the chip, in it, or out of it?
  bool busy() const {
    const auto& r = *top.rootp;
    bool line_busy = false;
#if !SPI
    line_busy = r.chip__DOT__serial__DOT__line__DOT__in_bit || r.chip__DOT__serial__DOT__line__DOT__out_bits;
#endif
    return line_busy || !to_box.empty() || send_bits || send_wait > 1 || got_bits ||
           r.chip__DOT__core__DOT__line__DOT__in__DOT__ending || r.chip__DOT__core__DOT__line__DOT__state ||
           r.chip__DOT__core__DOT__line__DOT__out__DOT__state;
  }

  IData& raw(int axis) {
    auto& r = *top.rootp;
    switch (axis) {
      case 0: return r.chip__DOT__core__DOT__axes__BRA__0__KET____DOT__axis__DOT__raw;
#if AXES > 2
      case 2: return r.chip__DOT__core__DOT__axes__BRA__2__KET____DOT__axis__DOT__raw;
#endif
      default: return r.chip__DOT__core__DOT__axes__BRA__1__KET____DOT__axis__DOT__raw;
    }
  }

  void set_encoder(int i) {
    const int lines = kGray[position[i] & 3];
    const uint32_t bit = 1u << i;
    top.a = (top.a & ~bit) | (lines & 1 ? bit : 0);
    top.b = (top.b & ~bit) | (lines & 2 ? bit : 0);
  }

  // So many clocks; every encoder goes evenly to its place, at most a count a clock. Gives the clocks that it took.
  //
  // Of a way that no machine goes in the time, the bulk, whole cycles of the lines, is put into the counters.
  int64_t go(int64_t n, const int64_t* places) {
    int64_t way[AXES], direction[AXES], sum[AXES], need = n;
    bool still = true;
    for (int i = 0; i < AXES; ++i) {
      int64_t far = places[i] - position[i];
      if (far > n + kFarthest || far < -n - kFarthest) {
        const int64_t bulk = far / 4 * 4;
        position[i] += bulk;
        raw(i) += static_cast<uint32_t>(bulk);
        controller[i].counts += bulk;
        far -= bulk;
      }
      way[i] = far < 0 ? -far : far;
      direction[i] = far < 0 ? -1 : 1;
      sum[i] = 0;
      still = still && far == 0;
      if (way[i] > need) need = way[i];
    }
    for (int64_t k = 0; k < need; ++k) {
      if (!still)
        for (int i = 0; i < AXES; ++i)
          if ((sum[i] += way[i]) >= need) {
            sum[i] -= need;
            position[i] += direction[i];
            set_encoder(i);
          }
      clock();
    }
    return need;
  }
};

extern "C" {

// axes, clk_hz, baud, spi
void chip_sizes(int64_t* out) {
  out[0] = AXES; out[1] = CLK_HZ; out[2] = BAUD; out[3] = SPI;
}

Chip* chip_new() { return new Chip; }
void chip_delete(Chip* chip, const char* coverage) {
#if VM_COVERAGE
  if (*coverage) chip->context.coveragep()->write(coverage);
#endif
  (void)coverage;
  chip->top.final();
  Verilated::threadContextp(&chip->context);  // this thread may have run another chip last, which is gone
  delete chip;
}

// settings: filter_length, whole_cycles, interval, limit, boot, box_serial, counter_bits, hold_after_ms, counts_per_s
void chip_settings(Chip* chip, const uint32_t* s) {
  Vchip& t = chip->top;
  t.filter_length = s[0]; t.whole_cycles = s[1]; t.interval = s[2]; t.limit = s[3]; t.given_boot = s[4];
  t.box_serial = s[5]; t.counter_bits = s[6]; t.hold_after_ms = s[7]; t.counts_per_s = s[8];
}

// Power off and on, with the encoders at zero; the controller begins to count then, too.
void chip_reset(Chip* chip) {
  Vchip& t = chip->top;
  t.ss_n = 1; t.sck = 0; t.z = 0; t.broken = 0; t.rst = 1;
  chip->to_box.clear();
  chip->from_box.clear();
  chip->send_wait = 1;
  chip->send_bits = chip->got_bits = 0;
  for (int i = 0; i < AXES; ++i) {
    chip->position[i] = 0;
    chip->set_encoder(i);
  }
  for (int i = 0; i < 80; ++i) chip->clock();
  t.rst = 0;
  chip->commands = 0;
  for (auto& c : chip->controller) c = Controller();
  for (int i = 0; i < 200; ++i) chip->clock();  // box.v: counting begins behind the longest filter
}

// Lines and power as the test wants them, for so many clocks; the controller counts from the end of the reset on.
void chip_power(Chip* chip, int rst, uint32_t a, uint32_t b, int64_t clocks) {
  Vchip& t = chip->top;
  t.rst = rst; t.a = a; t.b = b;
  if (rst)
    for (auto& c : chip->controller) c = Controller();
  for (int64_t i = 0; i < clocks; ++i) chip->clock();
}

void chip_broken(Chip* chip, uint32_t mask) { chip->top.broken = mask; }
void chip_pace(Chip* chip, double bit_clocks) { chip->bit_clocks = bit_clocks; }
void chip_freeze(Chip* chip, int frozen) { chip->frozen = frozen; }
void chip_glitch(Chip* chip, int clocks) { chip->glitch = clocks; }

// Registers that would take hours to get there: the time since the start, and how long nothing was heard.
void chip_time(Chip* chip, uint32_t time_us, uint32_t silent_ms) {
  chip->top.rootp->chip__DOT__core__DOT__watch__DOT__time_us = time_us;
  chip->top.rootp->chip__DOT__core__DOT__watch__DOT__silent_ms = silent_ms;
}

int chip_relay(Chip* chip) { return chip->top.relay; }
int chip_resumed(Chip* chip) { return chip->top.rootp->chip__DOT__core__DOT__line__DOT__resumed; }
int64_t chip_commands(Chip* chip) { return static_cast<int64_t>(chip->commands); }
void chip_send(Chip* chip, const uint8_t* data, int n) { chip->to_box.insert(chip->to_box.end(), data, data + n); }

int chip_receive(Chip* chip, uint8_t* data, int most) {
  int n = static_cast<int>(chip->from_box.size());
  if (n > most) n = most;
  std::memcpy(data, chip->from_box.data(), n);
  chip->from_box.erase(chip->from_box.begin(), chip->from_box.begin() + n);
  return n;
}

int64_t chip_run(Chip* chip, int64_t clocks, const int64_t* places) { return chip->go(clocks, places); }

// Encoders stand still until the link is at rest. Gives the clocks that it took, `most` at most.
int64_t chip_settle(Chip* chip, int64_t most) {
  int64_t n = 0;
  for (int rest = 0; rest < kRest && n < most; ++n) {
    chip->clock();
    rest = chip->busy() ? 0 : rest + 1;
  }
  return n;
}

// SPI, mode 0, as a master drives it: n bytes out and in, `half` clocks of ours for half a clock of the line.
void chip_spi(Chip* chip, const uint8_t* out, uint8_t* in, int n, int half) {
  Vchip& t = chip->top;
  auto wait = [&] { for (int i = 0; i < half; ++i) chip->clock(); };
  t.sck = 0;
  t.ss_n = 0;
  wait();
  for (int i = 0; i < n; ++i) {
    in[i] = 0;
    for (int bit = 7; bit >= 0; --bit) {
      t.rx = (out[i] >> bit) & 1;
      wait();
      in[i] |= t.tx << bit;
      t.sck = 1;
      wait();
      t.sck = 0;
    }
  }
  wait();
  t.ss_n = 1;
  wait();
}

// Lines sample by sample, a clock each, for one axis; out: what goes out at each clock.
void chip_lines(Chip* chip, int axis, int64_t n, const uint8_t* a, const uint8_t* b, const uint8_t* z, uint8_t* a_out,
                uint8_t* b_out, uint8_t* z_out) {
  Vchip& t = chip->top;
  const uint32_t bit = 1u << axis;
  for (int64_t i = 0; i < n; ++i) {
    t.a = (t.a & ~bit) | (a[i] ? bit : 0);
    t.b = (t.b & ~bit) | (b[i] ? bit : 0);
    t.z = (t.z & ~bit) | (z[i] ? bit : 0);
    chip->clock();
    a_out[i] = Chip::line(t.a_out, axis);
    b_out[i] = Chip::line(t.b_out, axis);
    z_out[i] = Chip::line(t.z_out, axis);
  }
}

void chip_ledger(Chip* chip, int axis, int64_t* out) {
  const Controller& c = chip->controller[axis];
  out[0] = word(chip->top.raw, axis);
  out[1] = word(chip->top.inserted, axis);
  out[2] = c.counts;
  out[3] = c.illegal;
  out[4] = c.closest;
  out[5] = word(chip->top.at_index, axis);
}
}
