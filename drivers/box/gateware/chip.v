// The box with its line: what a board's top ties to pins. `SPI` = 1 takes SPI instead of the UART.
`default_nettype none
module chip #(
    parameter AXES = 3,
    parameter CLK_HZ = 12_000_000,
    parameter BAUD = 3_000_000,
    parameter SPI = 0,
    parameter SEPARATION = 16,
    parameter FILTER_BITS = 6,
    parameter RATE_BITS = 20,
    parameter OWN_BOOT = 1  // 1: boot.v makes the number; 0: it comes in
) (
    input  wire                   clk,
    input  wire                   rst,
    input  wire [AXES-1:0]        a,
    input  wire [AXES-1:0]        b,
    input  wire [AXES-1:0]        z,
    input  wire [AXES-1:0]        broken,
    output wire [AXES-1:0]        a_out,
    output wire [AXES-1:0]        b_out,
    output wire [AXES-1:0]        z_out,
    output wire                   relay,
    input  wire                   rx,   // UART; SPI: the master's data
    output wire                   tx,   // UART; SPI: the box's data
    input  wire                   sck,
    input  wire                   ss_n,
    input  wire [FILTER_BITS-1:0] filter_length,
    input  wire                   whole_cycles,
    input  wire [RATE_BITS-1:0]   interval,
    input  wire [31:0]            limit,
    input  wire [15:0]            given_boot,
    input  wire [31:0]            box_serial,
    input  wire [7:0]             counter_bits,
    input  wire [15:0]            hold_after_ms,
    input  wire [31:0]            counts_per_s,
    output wire [32*AXES-1:0]     raw,
    output wire [32*AXES-1:0]     inserted,
    output wire [32*AXES-1:0]     at_index
);
  wire [7:0] rx_data, tx_data;
  wire rx_valid, tx_valid, tx_ready;
  wire [15:0] made, number = OWN_BOOT ? made : given_boot;
  boot start (.clk(clk), .rst(rst), .heard(rx_valid), .number(made));

  generate
    if (SPI) begin : bus
      spi line (
          .clk(clk), .rst(rst), .sck(sck), .mosi(rx), .miso(tx), .ss_n(ss_n), .rx_data(rx_data), .rx_valid(rx_valid),
          .tx_data(tx_data), .tx_valid(tx_valid), .tx_ready(tx_ready)
      );
    end else begin : serial
      uart #(.DIVISOR(CLK_HZ / BAUD)) line (
          .clk(clk), .rst(rst), .rx(rx), .tx(tx), .rx_data(rx_data), .rx_valid(rx_valid), .tx_data(tx_data),
          .tx_valid(tx_valid), .tx_ready(tx_ready)
      );
    end
  endgenerate

  box #(
      .AXES(AXES), .CLK_HZ(CLK_HZ), .SEPARATION(SEPARATION), .FILTER_BITS(FILTER_BITS), .RATE_BITS(RATE_BITS)
  ) core (
      .clk(clk), .rst(rst), .a(a), .b(b), .z(z), .broken(broken), .a_out(a_out), .b_out(b_out), .z_out(z_out),
      .relay(relay), .filter_length(filter_length), .whole_cycles(whole_cycles), .interval(interval), .limit(limit),
      .boot(number), .box_serial(box_serial), .counter_bits(counter_bits), .hold_after_ms(hold_after_ms),
      .counts_per_s(counts_per_s), .rx_data(rx_data), .rx_valid(rx_valid), .tx_data(tx_data), .tx_valid(tx_valid),
      .tx_ready(tx_ready), .raw(raw), .inserted(inserted), .at_index(at_index)
  );
endmodule
`default_nettype wire
