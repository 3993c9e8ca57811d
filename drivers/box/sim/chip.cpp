// The gateware as a library: encoders that move, a controller that counts, bytes on the serial line, clock by clock.
//
// The controller's counts are decoded from the lines that go out, by a decoder that shares nothing with the gateware.
#include <cstdint>
#include <cstring>
#include <deque>
#include <memory>
#include <vector>

#include "Vchip.h"
#include "verilated.h"
#if VM_COVERAGE
#include "verilated_cov.h"
#endif

namespace {

constexpr int kGray[4] = {0, 1, 3, 2};    // phase to lines, A in bit 0
constexpr int kPhase[4] = {0, 1, 3, 2};   // and back

struct Controller {
  int last = -1;
  int64_t counts = 0;
  int64_t illegal = 0;
  int64_t since = 1 << 30;      // clocks since the last edge
  int64_t closest = 1 << 30;    // least clocks between two edges
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

struct Chip {
  VerilatedContext context;
  std::unique_ptr<Vchip> top;
  int axes, divisor;
  uint64_t clocks = 0;
  std::vector<int64_t> position;
  std::vector<Controller> controller;
  // serial line, as a port on the other side drives and reads it
  std::deque<uint8_t> to_box;
  int sending = 0, send_wait = 0, send_bits = 0;
  std::vector<uint8_t> from_box;
  int got = 0, got_wait = 0, got_bits = 0;
  bool spi = false;  // the line is SPI's: nothing goes by itself

  Chip(int axes_, int divisor_) : top(new Vchip(&context)), axes(axes_), divisor(divisor_), position(axes_, 0),
                                  controller(axes_) {}

  int line(const uint32_t mask, int axis) const { return (mask >> axis) & 1; }

  void clock() {
    if (!spi) drive_line();
    top->clk = 0;
    top->eval();
    top->clk = 1;
    top->eval();
    ++clocks;
    if (!spi) read_line();
    if (!top->rst)
      for (int i = 0; i < axes; ++i) controller[i].see(line(top->a_out, i) | line(top->b_out, i) << 1);
  }

  void drive_line() {
    if (send_wait > 0) { --send_wait; return; }
    if (send_bits == 0) {
      if (to_box.empty()) { top->rx = 1; return; }
      sending = 0x200 | to_box.front() << 1;
      to_box.pop_front();
      send_bits = 10;
    }
    top->rx = sending & 1;
    sending >>= 1;
    --send_bits;
    send_wait = divisor - 1;
  }

  void read_line() {
    if (got_bits == 0) {
      if (!top->tx) { got_bits = 9; got_wait = divisor + divisor / 2 - 1; got = 0; }
      return;
    }
    if (got_wait-- > 0) return;
    got_wait = divisor - 1;
    if (--got_bits == 0) { if (top->tx) from_box.push_back(static_cast<uint8_t>(got)); }
    else got = got >> 1 | (top->tx ? 0x80 : 0);
  }

  void encoders() {
    uint32_t a = 0, b = 0;
    for (int i = 0; i < axes; ++i) {
      const int lines = kGray[position[i] & 3];
      a |= (lines & 1) << i;
      b |= (lines >> 1) << i;
    }
    top->a = a;
    top->b = b;
  }
};

int32_t word(const VlWide<3>& wide, int i) { return static_cast<int32_t>(wide[i]); }
template <typename T> int32_t word(const T& narrow, int i) { return static_cast<int32_t>(narrow >> (32 * i)); }

}  // namespace

extern "C" {

Chip* chip_new(int axes, int divisor) { return new Chip(axes, divisor); }
void chip_delete(Chip* chip) {
#if VM_COVERAGE
  chip->context.coveragep()->write("coverage.dat");
#endif
  chip->top->final();
  delete chip;
}

// settings: filter_length, whole_cycles, interval, limit, boot, box_serial, counter_bits, hold_after_ms, counts_per_s
void chip_settings(Chip* chip, const uint32_t* s) {
  Vchip& t = *chip->top;
  t.filter_length = s[0]; t.whole_cycles = s[1]; t.interval = s[2]; t.limit = s[3]; t.given_boot = s[4];
  t.box_serial = s[5]; t.counter_bits = s[6]; t.hold_after_ms = s[7]; t.counts_per_s = s[8];
}

// Power off and on, with the encoders at zero; the controller begins to count then, too.
void chip_reset(Chip* chip) {
  Vchip& t = *chip->top;
  t.ss_n = 1; t.sck = 0; t.z = 0; t.broken = 0; t.rst = 1;
  chip->to_box.clear();
  chip->from_box.clear();
  chip->send_bits = chip->send_wait = chip->got_bits = 0;
  for (auto& place : chip->position) place = 0;
  chip->encoders();
  for (int i = 0; i < 80; ++i) chip->clock();
  t.rst = 0;
  for (auto& c : chip->controller) c = Controller();
  for (int i = 0; i < 60; ++i) chip->clock();
}

void chip_broken(Chip* chip, uint32_t mask) { chip->top->broken = mask; }
int chip_relay(Chip* chip) { return chip->top->relay; }
void chip_send(Chip* chip, const uint8_t* data, int n) { chip->to_box.insert(chip->to_box.end(), data, data + n); }
int chip_pending(Chip* chip) { return static_cast<int>(chip->to_box.size()) + (chip->send_bits > 0); }

int chip_receive(Chip* chip, uint8_t* data, int most) {
  int n = static_cast<int>(chip->from_box.size());
  if (n > most) n = most;
  std::memcpy(data, chip->from_box.data(), n);
  chip->from_box.erase(chip->from_box.begin(), chip->from_box.begin() + n);
  return n;
}

// SPI, mode 0, as a master drives it: n bytes out and in, `half` clocks of ours for half a clock of the line.
void chip_spi(Chip* chip, const uint8_t* out, uint8_t* in, int n, int half) {
  Vchip& t = *chip->top;
  chip->spi = true;
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

// So many clocks; every encoder goes evenly to its place, at most a count in `gap` clocks. Gives the clocks that it took.
int64_t chip_run(Chip* chip, int64_t clocks, const int64_t* places, int gap) {
  std::vector<int64_t> start = chip->position;
  int64_t need = clocks;
  for (int i = 0; i < chip->axes; ++i) {
    const int64_t way = places[i] > start[i] ? places[i] - start[i] : start[i] - places[i];
    if (way * gap > need) need = way * gap;
  }
  for (int64_t n = 1; n <= need; ++n) {
    for (int i = 0; i < chip->axes; ++i)
      chip->position[i] = start[i] + static_cast<int64_t>(static_cast<__int128>(places[i] - start[i]) * n / need);
    chip->encoders();
    chip->clock();
  }
  return need;
}

// Lines sample by sample, a clock each, for one axis; out: what goes out at each clock.
void chip_lines(Chip* chip, int axis, int64_t n, const uint8_t* a, const uint8_t* b, const uint8_t* z, uint8_t* a_out,
                uint8_t* b_out, uint8_t* z_out) {
  Vchip& t = *chip->top;
  const uint32_t bit = 1u << axis;
  for (int64_t i = 0; i < n; ++i) {
    t.a = (t.a & ~bit) | (a[i] ? bit : 0);
    t.b = (t.b & ~bit) | (b[i] ? bit : 0);
    t.z = (t.z & ~bit) | (z[i] ? bit : 0);
    chip->clock();
    a_out[i] = chip->line(t.a_out, axis);
    b_out[i] = chip->line(t.b_out, axis);
    z_out[i] = chip->line(t.z_out, axis);
  }
}

void chip_ledger(Chip* chip, int axis, int64_t* out) {
  const Controller& c = chip->controller[axis];
  out[0] = word(chip->top->raw, axis);
  out[1] = word(chip->top->inserted, axis);
  out[2] = c.counts;
  out[3] = c.illegal;
  out[4] = c.closest;
  out[5] = word(chip->top->at_index, axis);
}
}
