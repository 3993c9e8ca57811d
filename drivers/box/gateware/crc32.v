// CRC-32 of the link (ISO-HDLC), a bit a clock: polynomial 04C11DB7 reflected, start all ones.
//
// `value` is the final one (inverted). A frame with its CRC behind leaves the residue that `good` shows.
`default_nettype none
module crc32 (
    input  wire        clk,
    input  wire        start,   // forget; wins over `put`
    input  wire        put,     // take `data`; only while not `busy`
    input  wire [7:0]  data,
    output wire        busy,
    output wire [31:0] value,
    output wire        good
);
  reg [31:0] register;
  reg [3:0] todo;
  assign busy  = todo != 0;
  assign value = ~register;
  assign good  = register == 32'hDEBB20E3;

  always @(posedge clk) begin
    if (start) begin
      register <= 32'hFFFFFFFF;
      todo <= 0;
    end else if (busy) begin
      register <= (register >> 1) ^ (register[0] ? 32'hEDB88320 : 32'd0);
      todo <= todo - 1'b1;
    end else if (put) begin
      register <= register ^ {24'd0, data};
      todo <= 4'd8;
    end
  end
endmodule
`default_nettype wire
