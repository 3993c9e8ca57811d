// The encoder box: AXES encoders in, the corrected signals out, and the RTEC box link to rtec.
//
// Everything that a board fixes comes in as a wire; boards/ has tops that tie them.
`default_nettype none
module box #(
    parameter AXES = 3,
    parameter CLK_HZ = 12_000_000,
    parameter SEPARATION = 16,      // least clocks between two edges that go out, one of them inserted
    parameter FILTER_BITS = 6,
    parameter RATE_BITS = 20,
    parameter SIZE_BITS = 6
) (
    input  wire                   clk,
    input  wire                   rst,
    input  wire [AXES-1:0]        a,
    input  wire [AXES-1:0]        b,
    input  wire [AXES-1:0]        z,
    input  wire [AXES-1:0]        broken,          // the receiver sees no proper signal; tie to 0 where it cannot tell
    output wire [AXES-1:0]        a_out,
    output wire [AXES-1:0]        b_out,
    output wire [AXES-1:0]        z_out,
    output reg                    relay,           // 1: the outputs go to the controller; 0: the encoders do
    input  wire [FILTER_BITS-1:0] filter_length,
    input  wire                   whole_cycles,
    input  wire [RATE_BITS-1:0]   interval,        // clocks from one inserted count to the next: CLK_HZ / counts_per_s
    input  wire [31:0]            limit,           // inserted counts never leave -limit … +limit
    input  wire [15:0]            boot,
    input  wire [31:0]            box_serial,
    input  wire [7:0]             counter_bits,
    input  wire [15:0]            hold_after_ms,
    input  wire [31:0]            counts_per_s,
    input  wire [7:0]             rx_data,
    input  wire                   rx_valid,
    output wire [7:0]             tx_data,
    output wire                   tx_valid,
    input  wire                   tx_ready,
    output wire [32*AXES-1:0]     raw,
    output wire [32*AXES-1:0]     inserted,
    output wire [32*AXES-1:0]     at_index
);
  wire [32*AXES-1:0] asked;
  wire [AXES-1:0] fault;
  reg [AXES-1:0] broken_then, broken_now;  // synchronised
  always @(posedge clk) {broken_now, broken_then} <= {broken_then, broken};

  // Counting begins when every filter has seen its line for longer than the longest filter.
  localparam SETTLED = 16;  // 2 ** SETTLED clocks, also for the relay
  reg [SETTLED:0] settled;
  reg starting;
  always @(posedge clk) begin
    settled  <= rst ? 0 : settled + !settled[SETTLED];
    starting <= rst || settled[SETTLED:FILTER_BITS+1] == 0;
  end

  reg [AXES-1:0] on_its_way;
  wire clear_fault, resumed, heard, held;
  wire [31:0] time_us;

  genvar n;
  generate
    for (n = 0; n < AXES; n = n + 1) begin : axes
      wire fa, fb, fz, illegal;
      filter #(.LENGTH_BITS(FILTER_BITS)) in_a (.clk(clk), .length(filter_length), .line(a[n]), .level(fa));
      filter #(.LENGTH_BITS(FILTER_BITS)) in_b (.clk(clk), .length(filter_length), .line(b[n]), .level(fb));
      filter #(.LENGTH_BITS(FILTER_BITS)) in_z (.clk(clk), .length(filter_length), .line(z[n]), .level(fz));
      wire signed [31:0] wanted = asked[32*n+:32];
      wire signed [31:0] most = limit;
      reg above, below;
      reg signed [31:0] waits, target, off;
      wire signed [31:0] is = inserted[32*n+:32];
      always @(posedge clk) begin
        above <= wanted > most;
        below <= wanted < -most;
        waits <= wanted;
        target <= starting ? 0 : above ? most : below ? -most : waits;
        off <= target - is;
      end
      inserter #(.SEPARATION(SEPARATION), .WIDTH(32), .RATE_BITS(RATE_BITS)) axis (
          .clk(clk), .rst(starting), .a(fa), .b(fb), .z(fz), .target(target), .hold(held), .whole_cycles(whole_cycles),
          .interval(interval), .clear_fault(clear_fault), .raw(raw[32*n+:32]), .inserted(inserted[32*n+:32]),
          .a_out(a_out[n]), .b_out(b_out[n]), .z_out(z_out[n]), .at_index(at_index[32*n+:32]), .fault(illegal)
      );
      reg seen_broken;
      always @(posedge clk) seen_broken <= !rst && (broken_now[n] || (seen_broken && !clear_fault));
      assign fault[n]  = illegal || seen_broken;
      always @(posedge clk) on_its_way[n] <= whole_cycles ? off > 2 || off < -2 || is[1:0] != 0 : off != 0;
    end
  endgenerate

  link #(.AXES(AXES), .SIZE_BITS(SIZE_BITS)) line (
      .clk(clk), .rst(rst), .boot(boot), .box_serial(box_serial), .counter_bits(counter_bits),
      .hold_after_ms(hold_after_ms), .counts_per_s(counts_per_s), .rx_data(rx_data), .rx_valid(rx_valid),
      .tx_data(tx_data), .tx_valid(tx_valid), .tx_ready(tx_ready), .raw(raw), .inserted(inserted), .moving(|on_its_way),
      .fault(|fault), .broken(|broken_now), .target(asked), .clear_fault(clear_fault), .time_us(time_us), .held(held),
      .resumed(resumed), .heard(heard)
  );
  watchdog #(.CLK_HZ(CLK_HZ)) watch (
      .clk(clk), .rst(rst), .enabled(resumed), .heard(heard), .hold_after_ms(hold_after_ms), .held(held),
      .time_us(time_us)
  );

  // The relay takes over once the outputs have followed the encoders for 2 ** 16 clocks; only a reset gives it back.
  always @(posedge clk) relay <= !rst && settled[SETTLED];
endmodule
`default_nettype wire
