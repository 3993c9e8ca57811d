// Input filter of one line: synchroniser, then a glitch filter.
//
// A level passes when it has been there for `length` + 1 clocks in a row; anything shorter leaves no trace. `length` = 0
// passes every level that the clock sees. The latency is 2 + 1 + `length` clocks, the same for both edges, so that lines
// with filters of one length keep their order.
`default_nettype none
module filter #(
    parameter LENGTH_BITS = 6
) (
    input  wire                   clk,
    input  wire [LENGTH_BITS-1:0] length,  // clocks that a level must last beyond the first; may change at rest
    input  wire                   line,    // from the receiver, asynchronous
    output reg                    level    // filtered
);
  reg [1:0] synced = 0;
  reg [LENGTH_BITS-1:0] lasted = 0;
  initial level = 0;

  always @(posedge clk) begin
    synced <= {synced[0], line};
    if (synced[1] == level) lasted <= 0;
    else if (lasted >= length) begin
      level  <= synced[1];
      lasted <= 0;
    end else lasted <= lasted + 1'b1;
  end
endmodule
`default_nettype wire
