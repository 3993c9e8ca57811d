// Frames in: bytes of the line to a checked frame in a small memory (docs/rtec-box-link.md, "Frame").
//
// Undoes COBS byte by byte, checks the CRC on the way. `done` is one clock: a whole frame with a good CRC, `size` bytes
// without it, is in the memory until the next byte comes. What is no frame leaves no trace.
`default_nettype none
module frame_in #(
    parameter SIZE_BITS = 6  // frames of up to 2 ** SIZE_BITS - 1 bytes, CRC with them; longer ones are none
) (
    input  wire                 clk,
    input  wire                 rst,
    input  wire [7:0]           data,
    input  wire                 valid,
    output reg                  done,
    output reg  [SIZE_BITS-1:0] size,
    input  wire [SIZE_BITS-1:0] at,
    output reg  [7:0]           value   // byte `at` of the frame, a clock later
);
  reg [7:0] memory[0:(1<<SIZE_BITS)-1];
  reg [SIZE_BITS-1:0] length;
  reg [7:0] to_zero;  // distance to the next zero; 0: no block has begun
  reg too_long, ending;

  wire in_block = to_zero != 0;
  wire is_zero = to_zero == 8'd1;
  wire put = valid && data != 0 && in_block;
  wire [7:0] plain = is_zero ? 8'd0 : data;
  wire full = &length;
  wire busy, good;
  wire [31:0] unused;
  crc32 check (
      .clk(clk), .start(rst || (valid && !in_block)), .put(put), .data(plain), .busy(busy), .value(unused), .good(good)
  );

  always @(posedge clk) begin
    done  <= 0;
    value <= memory[at];
    if (put && !full) memory[length] <= plain;
    if (rst) begin
      to_zero <= 0;
      ending <= 0;
      size <= 0;
      length <= 0;
      too_long <= 0;
    end else if (valid && data == 0) begin
      ending <= in_block && is_zero && !too_long && length >= 8;
      size <= length - 3'd4;
      to_zero <= 0;
    end else if (valid && !in_block) begin
      to_zero <= data;
      length <= 0;
      too_long <= 0;
    end else if (valid) begin
      to_zero <= is_zero ? data : to_zero - 1'b1;
      length <= length + !full;
      too_long <= too_long || full;
    end
    if (ending && !busy) begin
      ending <= 0;
      done <= good;
    end
  end
endmodule
`default_nettype wire
