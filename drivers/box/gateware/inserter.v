// Inserter of one axis: decodes A and B, adds counts between their edges, and encodes the sum.
//
//     corrected = raw + inserted, at every clock
//
// The rules are those of docs/pulse-insertion.md, a clock for a sample. The decided sample is SEPARATION - 1 clocks old:
// what came after it is the look-ahead that keeps an inserted edge clear of the raw edge behind it.
//
// - A raw edge passes with a fixed latency and is never moved. A transition of both lines at once passes as it is; it
//   counts nothing and is flagged.
// - An inserted edge has no other edge nearer than SEPARATION clocks. Where the axis moves too fast, the count waits.
// - A count against the motion may be made by leaving a raw edge out.
// - Between two inserted counts there are at least `interval` clocks.
// - `whole_cycles`: four counts at a time; a cycle once begun is finished, and more than half a one must be wanting.
// - The target of three clocks ago counts: its long subtraction and what follows from it take a clock each, and what was
//   inserted meanwhile is taken off. So no path holds more than one sum of WIDTH bits.
`default_nettype none
module inserter #(
    parameter SEPARATION = 16,  // clocks, at least 2
    parameter WIDTH      = 32,  // bits of raw, inserted and corrected
    parameter RATE_BITS  = 16
) (
    input  wire                    clk,
    input  wire                    rst,           // ledger to zero; lines pass
    input  wire                    a,             // filtered lines
    input  wire                    b,
    input  wire                    z,
    input  wire signed [WIDTH-1:0] target,        // inserted counts wanted, absolute
    input  wire                    hold,          // nothing is inserted, but for the rest of a cycle that is begun
    input  wire                    whole_cycles,
    input  wire [RATE_BITS-1:0]    interval,      // clocks from one inserted count to the next, at least 1
    input  wire                    clear_fault,
    output reg signed [WIDTH-1:0]  raw,           // counts of the encoder, x4, A before B is positive
    output reg signed [WIDTH-1:0]  inserted,
    output wire                    a_out,         // lines of the corrected signal
    output wire                    b_out,
    output wire                    z_out,         // the index as it came, with the latency of A and B
    output reg signed [WIDTH-1:0]  at_index,      // raw count at the last rising index
    output reg                     fault          // both lines changed at once, since the last clear
);
  localparam NEAR_BITS = $clog2(SEPARATION + 2);
  localparam [NEAR_BITS-1:0] CLEAR = SEPARATION;

  // The last SEPARATION samples as phases 0..3 along positive motion; the oldest one is decided.
  wire [1:0] phase_in = {b, a ^ b};
  reg [1:0] phase[0:SEPARATION-1];
  reg [SEPARATION-1:0] index;
  reg [1:0] was;  // phase of the sample before the decided one
  reg index_before;
  reg [NEAR_BITS-1:0] filled;
  integer i;
  always @(posedge clk) begin
    phase[0] <= phase_in;
    for (i = 1; i < SEPARATION; i = i + 1) phase[i] <= phase[i-1];
    index <= {index[SEPARATION-2:0], z};
    was <= phase[SEPARATION-1];
    index_before <= index[SEPARATION-1];
    if (rst) filled <= 0;
    else if (filled != CLEAR + 1'b1) filled <= filled + 1'b1;
  end
  wire running = filled == CLEAR + 1'b1;  // the delay line holds samples, and the one before the decided one

  // What the decided sample is, and what is near it.
  wire [1:0] change = phase[SEPARATION-1] - was;
  wire raw_up = change == 2'd1, raw_down = change == 2'd3, raw_both = change == 2'd2;
  wire raw_edge = change != 2'd0;
  wire edge_in = phase[0] != phase[1];  // enters the look-ahead: a change of the newest sample
  reg [NEAR_BITS-1:0] since_in, since_raw, since_edge;
  wire ahead_clear = since_in >= CLEAR - 2 && !edge_in;
  wire behind_clear = since_raw >= CLEAR - 1 && since_edge >= CLEAR - 1;

  // What is wanted: how far the target of three clocks ago is from here, as far as it matters (-6 … 6), less what the
  // clocks since then have inserted. The last of them chooses between three answers that are ready.
  reg signed [WIDTH-1:0] off;
  reg signed [3:0] near_off;
  reg signed [1:0] step, step_before;  // what the last two clocks inserted
  wire signed [4:0] base = near_off - step - step_before;
  reg [2:0] over, under, far_over, far_under;  // if the clock before inserted nothing, a count up, a count down
  wire [1:0] last = step[1] ? 2'd2 : {1'b0, step[0]};
  reg signed [3:0] left;               // counts to the end of the cycle that is begun
  wire more = left == 0 && !hold && far_over[last], less = left == 0 && !hold && far_under[last];
  wire signed [3:0] cycle = more ? 4'sd4 : less ? -4'sd4 : left;
  reg [RATE_BITS-1:0] to_wait;
  reg due;
  wire wants_up = running && due && (whole_cycles ? cycle > 0 : !hold && over[last]);
  wire wants_down = running && due && (whole_cycles ? cycle < 0 : !hold && under[last]);

  wire alone = !raw_edge && ahead_clear && behind_clear;
  wire up = wants_up && (alone || raw_down);
  wire down = wants_down && (alone || raw_up);
  wire insert = up || down;
  wire signed [1:0] step_now = up ? 2'sd1 : down ? -2'sd1 : 2'sd0;
  wire signed [WIDTH-1:0] inserted_next = inserted + step_now;

  // Lines and ledger change at the same clock.
  reg [1:0] phase_out;
  reg z_late;
  always @(posedge clk) begin
    if (rst || !running) begin
      raw <= 0;
      inserted <= 0;
      off <= 0;
      near_off <= 0;
      {over, under, far_over, far_under} <= 0;
      step <= 0;
      step_before <= 0;
      left <= 0;
      due <= 1;
      fault <= 0;
      at_index <= 0;
      since_raw <= CLEAR;
      since_edge <= CLEAR;
      to_wait <= 0;
    end else begin
      raw <= raw + (raw_up ? 1 : raw_down ? -1 : 0);
      inserted <= inserted_next;
      off <= target - inserted;
      near_off <= off > 6 ? 4'sd6 : off < -6 ? -4'sd6 : off[3:0];
      over <= {base > -1, base > 1, base > 0};
      under <= {base < -1, base < 1, base < 0};
      far_over <= {base > 1, base > 3, base > 2};
      far_under <= {base < -3, base < -1, base < -2};
      step <= step_now;
      step_before <= step;
      left <= whole_cycles ? cycle - step_now : 4'sd0;
      fault <= raw_both || (fault && !clear_fault);
      if (index[SEPARATION-1] && !index_before) at_index <= raw + (raw_up ? 1 : raw_down ? -1 : 0);
      since_raw <= raw_edge ? 0 : since_raw + (since_raw != CLEAR);
      since_edge <= insert && !raw_edge ? 0 : since_edge + (since_edge != CLEAR);
      to_wait <= insert ? interval : to_wait - !due;
      due <= insert ? interval <= 1 : to_wait <= 2;
    end
    since_in <= edge_in ? 0 : since_in + (since_in != CLEAR);
    phase_out <= phase[SEPARATION-1] + (rst || !running ? 2'd0 : inserted_next[1:0]);
    z_late <= index[SEPARATION-1];
  end
  assign a_out = phase_out[1] ^ phase_out[0];
  assign b_out = phase_out[1];
  assign z_out = z_late;
`ifdef FORMAL
`include "formal/inserter.vh"
`endif
endmodule
`default_nettype wire
