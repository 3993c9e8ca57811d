// Watchdog: is the line to rtec alive?
//
// Silent for more than `hold_after_ms` since the last `heard`: `held` is set, and stays until the next one.
`default_nettype none
module watchdog #(
    parameter CLK_HZ = 12_000_000,
    parameter US_PER_MS = 1000  // smaller in the proof
) (
    input  wire        clk,
    input  wire        rst,
    input  wire        enabled,        // not resumed: nothing is waited for
    input  wire        heard,          // a command was taken, one clock
    input  wire [15:0] hold_after_ms,
    output reg         held,
    output reg  [31:0] time_us         // since reset, wraps
);
  localparam CLKS_PER_US = CLK_HZ / 1_000_000;
  localparam PRE_BITS = $clog2(CLKS_PER_US + 1);
  reg [PRE_BITS-1:0] pre;
  wire tick_us = pre == CLKS_PER_US - 1;
  reg [9:0] us;
  wire tick_ms = tick_us && us == US_PER_MS - 1;
  reg [16:0] silent_ms;

  always @(posedge clk) begin
    pre <= rst || tick_us ? 0 : pre + 1'b1;
    time_us <= rst ? 0 : time_us + tick_us;
    if (rst || heard || !enabled) begin
      us <= 0;
      silent_ms <= 0;
      held <= 0;
    end else begin
      if (tick_us) us <= tick_ms ? 10'd0 : us + 1'b1;
      if (tick_ms && !held) silent_ms <= silent_ms + 1'b1;
      if (silent_ms > hold_after_ms) held <= 1;
    end
  end
`ifdef FORMAL
`include "formal/watchdog.vh"
`endif
endmodule
`default_nettype wire
