// UPduino 3 (iCE40 UP5K): three axes on its rows of pins, the link by a USB serial adapter of 3.3 V at 3 Mbaud.
`default_nettype none
module upduino (
    input  wire       clk_12mhz,
    input  wire [2:0] a,
    input  wire [2:0] b,
    input  wire [2:0] z,
    output wire [2:0] a_out,
    output wire [2:0] b_out,
    output wire [2:0] z_out,
    output wire       relay,
    input  wire       rx,
    output wire       tx
);
  reg [3:0] starting = 0;
  always @(posedge clk_12mhz) starting <= starting + !(&starting);

  chip #(.AXES(3), .CLK_HZ(12_000_000), .BAUD(3_000_000)) box (
      .clk(clk_12mhz), .rst(!(&starting)), .a(a), .b(b), .z(z), .broken(3'd0), .a_out(a_out), .b_out(b_out),
      .z_out(z_out), .relay(relay), .rx(rx), .tx(tx), .sck(1'b0), .ss_n(1'b1), .filter_length(6'd1),
      .whole_cycles(1'b0), .interval(20'd600), .limit(32'd100_000), .given_boot(16'd0), .box_serial(32'd1),
      .counter_bits(8'd32), .hold_after_ms(16'd100), .counts_per_s(32'd20_000), .raw(), .inserted(), .at_index()
  );
endmodule
`default_nettype wire
