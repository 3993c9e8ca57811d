// A number that differs from start to start: the clock count at which the first byte came.
//
// Two starts have the same one with a chance of 1 in 65536.
`default_nettype none
module boot (
    input  wire        clk,
    input  wire        rst,
    input  wire        heard,   // a byte came
    output reg  [15:0] number
);
  reg known;
  initial number = 0;
  always @(posedge clk)
    if (rst) known <= 0;  // the count itself goes on
    else begin
      known  <= known || heard;
      number <= number + !(known || heard);
    end
endmodule
`default_nettype wire
